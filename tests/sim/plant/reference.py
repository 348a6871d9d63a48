"""The motor and its shaft written a second time, in the rotor frame, for scipy: an oracle that shares no code."""

import numpy as np
from scipy.integrate import solve_ivp


class Reference:
    """d-q equations with ideal voltages, viscous and dry friction, and a constant torque against positive speed."""

    def __init__(self, R_s, L_d, L_q, psi_f, n_p, J, b, tau_dry):
        self.R_s, self.L_d, self.L_q, self.psi_f, self.n_p = R_s, L_d, L_q, psi_f, n_p
        self.J, self.b, self.tau_dry = J, b, tau_dry

    def torque(self, i_d, i_q):
        return 1.5 * self.n_p * (self.psi_f * i_q + (self.L_d - self.L_q) * i_d * i_q)

    def rates(self, t, x, u_alpha, u_beta):
        i_d, i_q, omega_m, theta = x
        omega_e = self.n_p * omega_m
        u_d = u_alpha * np.cos(theta) + u_beta * np.sin(theta)
        u_q = u_beta * np.cos(theta) - u_alpha * np.sin(theta)
        return [
            (u_d - self.R_s * i_d + omega_e * self.L_q * i_q) / self.L_d,
            (u_q - self.R_s * i_q - omega_e * (self.L_d * i_d + self.psi_f)) / self.L_q,
            (self.torque(i_d, i_q) - self.b * omega_m - self.tau_dry * np.sign(omega_m)) / self.J,
            omega_e,
        ]

    def solve(self, x, span, u_alpha=0.0, u_beta=0.0, t_eval=None, events=None):
        return solve_ivp(
            self.rates, (0.0, span), x, "DOP853", t_eval, args=(u_alpha, u_beta), rtol=1e-10, atol=1e-12,
            events=events,
        )  # fmt: skip
