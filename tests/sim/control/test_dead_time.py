import numpy as np
import pytest

from sim.control import dead_time

NOTHING = dead_time.Left(0.0, 0.0)
U = (1.0, 0.0)  # V


VALUES = {"dead_time_hat": 1e-6, "dead_time_comp": 1.0, "dead_time_learn": 0.0, "R_s_hat": 0.158}
VALUES |= {"L_s_hat": 0.176e-3, "omega_on": 20.0}


def made(**other):
    return dead_time.make_params(16_000, **VALUES | other)


PARAMS = made()


def added(current, params=PARAMS):
    return dead_time.compensate(params, NOTHING, U, (0.5, 0.5, 0.5), (current, -current, 0.0))


def test_full_current_gets_back_what_the_dead_time_takes():
    """1 us in 62.5 us of 24 V is 0.384 V, against the current's sign."""
    d_a, d_b, d_c = added(4.0)
    assert (d_a - 0.5) * 24 == pytest.approx(0.384)
    assert (d_b - 0.5) * 24 == pytest.approx(-0.384)
    assert d_c == 0.5


def test_it_fades_smoothly_through_zero_current():
    currents = np.linspace(-1, 1, 401)
    gain = np.array([added(i)[0] - 0.5 for i in currents])
    assert np.all(np.diff(gain) >= 0)
    np.testing.assert_allclose(gain, -gain[::-1], atol=1e-15)
    assert np.diff(gain).max() <= 0.016 * (currents[1] - currents[0]) / 0.3 * 1.001


def test_the_share_scales_and_zero_switches_it_off():
    part = made(dead_time_comp=0.9)
    none = made(dead_time_comp=0.0)
    assert added(4.0, part)[0] - 0.5 == pytest.approx(0.9 * (added(4.0)[0] - 0.5))
    assert added(4.0, none) == (0.5, 0.5, 0.5)


def test_duties_stay_within_0_and_1():
    assert dead_time.compensate(PARAMS, NOTHING, U, (0.999, 0.001, 0.5), (5.0, -5.0, 0.0)) == (1.0, 0.0, 0.5)


def test_it_fades_where_the_ripple_does():
    """Twice the inductance, half the ripple, half the current."""
    smooth = made(L_s_hat=0.352e-3)
    assert added(0.05, smooth)[0] == pytest.approx(added(0.1)[0])
    assert added(0.15, smooth)[0] == pytest.approx(added(4.0)[0])
    assert added(0.15)[0] < added(4.0)[0]


def learned(omegas, *, amps=4.0, error=0.2, at=0.3, **other):
    """What is left after periods at these speeds, of a motor whose legs lose `error` V beyond a current of `at` A.

    The voltage is the motor's equation, written down, less what has been learned and is given back; as shares of a
    period. A quarter of the PWM frequency and four times the inductance: the ripple is as before, and there is less to
    go through.
    """
    params = dead_time.make_params(4000.0, **VALUES | {"dead_time_learn": 1.0, "L_s_hat": 0.704e-3} | other)
    T_S, L = 1 / 4000, 0.704e-3
    theta = np.concatenate([[0.0], np.cumsum(omegas) * T_S])
    i = 1j * amps * np.exp(1j * theta)
    turn = np.exp(2j * np.pi / 3)
    mean = 0.5 * (i[1:] + i[:-1])
    phases = [(mean * turn**-k).real for k in range(3)]

    def fading(at):
        return 2 / 3 * sum(np.clip(phase / at, -1, 1) * turn**k for k, phase in enumerate(phases))

    def ripple(volts):
        """A, the current at which the loss of a leg fades, fitted to a switched inverter."""
        return 0.18 * volts * T_S / L

    full = fading(0.3)
    emf = 1j * omegas * 6.55e-3 * np.exp(0.5j * (theta[1:] + theta[:-1]))
    u = 0.158 * mean + L * np.diff(i) / T_S + emf + error * fading(ripple(0.7) if at is None else at)
    state = dead_time.begun(dead_time.init(), i[0].real, i[0].imag)
    near = fading(ripple(np.abs(u))) - full
    for k, omega in enumerate(omegas):
        now = u[k] - 24.0 / T_S * (state.left.full * full[k] + state.left.near * near[k])
        state = dead_time.learnt(params, state, 24.0, now.real, now.imag, i[k + 1].real, i[k + 1].imag, omega)
    return state.left.full / T_S, state.left.near / T_S


STEADY = np.full(8_000, 80.0)
SWINGING = 80.0 + 25.0 * np.sin(np.arange(8_000) / 4000 * 9.0)
CASES = {  # speeds, what else; what is left, V, at full current and near none
    "backwards": (-STEADY, {}, 0.2, 0.0),
    "too much compensation": (STEADY, {"error": -0.1}, -0.1, 0.0),
    "there near zero current, as the ripple": (STEADY, {"at": None, "amps": 1.0}, 0.2, 0.2),
    "1 A": (STEADY, {"amps": 1.0}, 0.2, 0.0),
    "8 A": (STEADY, {"amps": 8.0}, 0.2, 0.0),
    "a wrong resistance turns with the rotor": (STEADY, {"R_s_hat": 0.25}, 0.2, 0.0),
    "a wrong inductance too": (STEADY, {"L_s_hat": 0.84e-3}, 0.2, 0.0),
    "a speed that changes teaches nothing": (SWINGING, {}, 0.0, 0.0),
    "no error": (STEADY, {"error": 0.0}, 0.0, 0.0),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_left_is_learned(case):
    """Of 24 V."""
    omegas, how, full, near = CASES[case]
    tolerance = 8e-4 if omegas is SWINGING else 5e-4
    assert learned(omegas, **how) == pytest.approx((full / 24, near / 24), rel=0.15, abs=tolerance)


def test_what_was_learned_is_given_back():
    params = made(dead_time_comp=0.0, dead_time_learn=1.0)
    given = dead_time.compensate(params, dead_time.Left(1e-6, 0.0), U, (0.5, 0.5, 0.5), (4.0, -4.0, 0.0))
    assert given == pytest.approx(added(4.0))
    off = dead_time.compensate(made(), dead_time.Left(1e-6, 1e-6), U, (0.5, 0.5, 0.5), (4.0, -4.0, 0.0))
    assert off == added(4.0)
