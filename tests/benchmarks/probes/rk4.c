/* The floor of the plant: the same equations by the classic Runge-Kutta method, one step a period, and nothing else.

   d psi / dt = u - R_s i - loss(i),  i = (psi - psi_f e^(j theta)) / L,  J d omega / dt = tau - b omega - tau_dry,
   d e^(j theta) / dt = j n_p omega e^(j theta);  loss: what dead time takes of each phase, linear below i_smooth.
   e^(j theta) is integrated too: with cos and sin of the angle in each stage it takes twice as long. The voltage is
   constant in the rotor's frame at the begin of each period. */

typedef struct {
    double R_s, g, psi_f, n_p, k_tau; /* ohm, 1/H, V s, pole pairs, 3/2 n_p */
    double e, g_smooth;               /* V, 1/A */
    double gain, b, tau_dry;          /* 1/(kg m2), N m s/rad, N m */
    double u_d, u_q;                  /* V */
} Params;

typedef struct {
    double psi_alpha, psi_beta, omega_m, cos, sin;
} State;

static double sat(double x) { return x > 1.0 ? 1.0 : x < -1.0 ? -1.0 : x; }

static State rates(const Params *p, State x, double u_alpha, double u_beta) {
    double i_alpha = p->g * (x.psi_alpha - p->psi_f * x.cos), i_beta = p->g * (x.psi_beta - p->psi_f * x.sin);
    double i_b = 0.8660254037844386 * i_beta - 0.5 * i_alpha, i_c = -i_alpha - i_b;
    double a = p->e * sat(p->g_smooth * i_alpha), b = p->e * sat(p->g_smooth * i_b), c = p->e * sat(p->g_smooth * i_c);
    double tau = p->k_tau * (x.psi_alpha * i_beta - x.psi_beta * i_alpha), omega_e = p->n_p * x.omega_m;
    State rate = {
        u_alpha - p->R_s * i_alpha - (2.0 * a - b - c) * 0.3333333333333333,
        u_beta - p->R_s * i_beta - (b - c) * 0.5773502691896258,
        p->gain * (tau - p->b * x.omega_m - p->tau_dry),
        -omega_e * x.sin,
        omega_e * x.cos,
    };
    return rate;
}

static State after(State x, State rate, double h) {
    State next = {x.psi_alpha + h * rate.psi_alpha, x.psi_beta + h * rate.psi_beta, x.omega_m + h * rate.omega_m,
                  x.cos + h * rate.cos, x.sin + h * rate.sin};
    return next;
}

static double mean(double k1, double k2, double k3, double k4) { return k1 + 2.0 * (k2 + k3) + k4; }

void run(const Params *p, State *at, double h, long n) {
    State x = *at;
    for (long k = 0; k < n; k++) {
        double u_alpha = p->u_d * x.cos - p->u_q * x.sin, u_beta = p->u_d * x.sin + p->u_q * x.cos;
        State k1 = rates(p, x, u_alpha, u_beta), k2 = rates(p, after(x, k1, 0.5 * h), u_alpha, u_beta);
        State k3 = rates(p, after(x, k2, 0.5 * h), u_alpha, u_beta), k4 = rates(p, after(x, k3, h), u_alpha, u_beta);
        State sum = {mean(k1.psi_alpha, k2.psi_alpha, k3.psi_alpha, k4.psi_alpha),
                     mean(k1.psi_beta, k2.psi_beta, k3.psi_beta, k4.psi_beta),
                     mean(k1.omega_m, k2.omega_m, k3.omega_m, k4.omega_m),
                     mean(k1.cos, k2.cos, k3.cos, k4.cos), mean(k1.sin, k2.sin, k3.sin, k4.sin)};
        x = after(x, sum, h * (1.0 / 6.0));
    }
    *at = x;
}
