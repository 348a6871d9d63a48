"""An ideal motor's signals, straight from its equations: what the observers' tests feed them. No simulation.

The rotor's angle is prescribed. Currents are prescribed in the rotor frame, and the voltages that go with them
follow from u = R i + L di/dt + d(psi e^{j theta})/dt, averaged over each period: the back-EMF's mean is exactly
psi (e^{j theta(k)} - e^{j theta(k-1)}) / T_s, whatever the rotor does.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sim.native import layout
from sim.observers import hall_speed, sample
from sim.observers.entry import Entry, Observing, names

TICK_HZ = 20_000_000
PWM_HZ = 16_000
TICKS = TICK_HZ // PWM_HZ
T_S = 1.0 / PWM_HZ
R_S, L_S, PSI_F, N_P = 0.158, 0.176e-3, 6.55e-3, 6  # Table II
TABLE_I = np.array([-1.2, -3.0, 7.2, -3.3, 0.6, 5.6])  # deg
PAPER_EDGES = np.arange(6) * 60.0 - TABLE_I  # deg, where sector s opens
IDEAL_EDGES = np.arange(6) * 60.0
MILLI = 1 / 1024  # V and A, a count
CODES = np.array([0b001, 0b011, 0b010, 0b110, 0b100, 0b101], np.uint8)  # by sector

DRIVE = {
    "n_p": N_P,
    "omega_m_max": 314.159,
    "hall_timeout": 0.2,
    "R_s_hat": R_S,
    "L_s_hat": L_S,
    "psi_f_hat": PSI_F,
    "k_p_vt": 1268.0,
    "k_i_vt": 54289.0,
    "tau_max": 4e-4,
    "omega_on": 20.0,
    "omega_off": 12.0,
    "k_pc": 0.0,
    "k_ic": 0.0,
    "load_angle_comp": 0.0,
    "literal_sgn": 0.0,
    "bw_omega_lpf": 50.0,
    "inject": 0.0,
    "inject_amplitude": 0.0,
    "inject_hz": 0.0,
    "J_hat": 2.0e-4,
    "u_dc_min": 12.0,
    "bw_hall_vector": 10.0,
    "learn_edges": 1.0,
    "edge_sd": 0.0087,
    "i_range": 20.0,
    "hall_offset": 0.0,
    **{f"edge_{way}_{s}": 0.0 for way in ("up", "down") for s in range(1, 7)},
}


def own(observer, **drive):
    """The settings of an observer's module, from DRIVE with some changed."""
    return observer.Settings(**{name: {**DRIVE, **drive}[name] for name in names(observer.Settings)})


class Signals(NamedTuple):
    """What a drive would telemeter, and the truth."""

    tick: np.ndarray
    hall: np.ndarray
    u_alpha: np.ndarray
    u_beta: np.ndarray
    i_a: np.ndarray
    i_b: np.ndarray
    i_c: np.ndarray
    i_q_err: np.ndarray  # A, of the current loop
    edge_tick: np.ndarray
    edge_hall: np.ndarray
    theta: np.ndarray  # truth, unwrapped

    @property
    def measured(self) -> np.ndarray:
        """What the front end takes of them, edges aside."""
        return np.rec.fromarrays(self[:8], layout(sample.Measured))

    @property
    def edges(self) -> np.ndarray:
        """The edges, as the front end takes them."""
        return np.rec.fromarrays([self.edge_tick, self.edge_hall], layout(hall_speed.Edge))


def rpm(value: float) -> float:
    """Electrical rad/s."""
    return value * 2 * np.pi / 60 * N_P


def sectors(theta: np.ndarray, edges_deg: np.ndarray = IDEAL_EDGES) -> np.ndarray:
    """Sectors counted on through the turns (the sector is this modulo 6), for sensors without hysteresis."""
    turn = np.floor((theta - np.radians(edges_deg[0])) / (2 * np.pi))
    within = theta - 2 * np.pi * turn
    return (6 * turn + np.searchsorted(np.radians(edges_deg), within, side="right") - 1).astype(np.int64)


def edges(theta: np.ndarray, edges_deg: np.ndarray = IDEAL_EDGES, fine: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Ticks and new codes of the edges of an angle given every TICKS / fine ticks, straight between the points."""
    count = sectors(theta, edges_deg)
    ticks, codes = [], []
    for k in np.flatnonzero(np.diff(count)):
        step = 1 if count[k + 1] > count[k] else -1
        for new in range(count[k] + step, count[k + 1] + step, step):
            opened = new if step > 0 else new + 1  # the boundary belongs to the sector that it opens
            boundary = np.radians(edges_deg[opened % 6]) + 2 * np.pi * (opened // 6)
            share = (boundary - theta[k]) / (theta[k + 1] - theta[k])
            ticks.append(int(np.ceil((k + share) * TICKS / fine)))
            codes.append(CODES[new % 6])
    return np.array(ticks, np.int64), np.array(codes, np.uint8)


def voltage(i: np.ndarray, rotor: np.ndarray) -> np.ndarray:
    """Mean over the period before each sample, V, by currents (A) and e^{j theta}, all of them complex (n,)."""
    before = np.r_[0, np.arange(len(i) - 1)]
    return R_S * (i + i[before]) / 2 + (L_S * (i - i[before]) + PSI_F * (rotor - rotor[before])) / T_S


def signals(
    theta_of_t,
    seconds: float,
    *,
    i_q=4.0,
    edges_deg: np.ndarray = IDEAL_EDGES,
    fine: int = 1,
    noise: float = 0.0,
    seed: int = 0,
) -> Signals:
    """Signals of a rotor at `theta_of_t(t)` (rad, a function of an array of seconds) with `i_q` A and no i_d."""
    n = round(seconds * PWM_HZ)
    theta = theta_of_t(np.arange(n) * T_S)
    dense = theta_of_t(np.arange((n - 1) * fine + 1) * T_S / fine)
    edge_tick, edge_hall = edges(dense, edges_deg, fine)
    i_q = np.broadcast_to(np.asarray(i_q, float), n)
    rotor = np.exp(1j * theta)
    i = 1j * i_q * rotor
    u = voltage(i, rotor)
    rng = np.random.default_rng(seed)
    phase = [(i * np.exp(-2j * np.pi / 3 * k)).real + noise * rng.standard_normal(n) for k in range(3)]
    return Signals(
        np.arange(n, dtype=np.int64) * TICKS,
        CODES[sectors(theta, edges_deg) % 6],
        u.real.copy(),
        u.imag.copy(),
        *phase,
        np.zeros(n),
        edge_tick,
        edge_hall,
        theta,
    )


def constant(omega: float, theta_0: float = 0.3):
    """Angle of a rotor at constant electrical speed."""
    return lambda t: theta_0 + omega * t


def ramp(*points):
    """Angle of a rotor whose electrical speed goes straight between (s, rad/s)."""
    t, omega = (np.array(c, float) for c in zip(*points, strict=True))
    grid = np.arange(0.0, t[-1] + 1e-3, T_S / 4)
    angle = 0.3 + np.r_[0, np.cumsum(np.interp(grid[:-1] + T_S / 8, t, omega))] * (T_S / 4)
    return lambda at: np.interp(at, grid, angle)


def turning_back(omega: float, at: float, deceleration: float, theta_0: float = 0.0):
    """Angle of a rotor that brakes from `at` s on at a constant rate until it runs backwards as fast."""
    turned = 2 * omega / deceleration

    def angle(t):
        past = np.maximum(t - at - turned, 0)
        return theta_0 + omega * (t - 2 * past) - deceleration / 2 * np.clip(t - at, 0, turned) ** 2

    return angle


def quantised(s: Signals) -> Signals:
    """As telemetry carries them."""
    names = ("u_alpha", "u_beta", "i_a", "i_b", "i_c", "i_q_err")
    return s._replace(**{name: np.round(getattr(s, name) / MILLI) * MILLI for name in names})


def error_deg(actual: np.ndarray, estimated: np.ndarray) -> np.ndarray:
    """Actual less estimated angle (rad) in degrees within [-180, 180)."""
    return (np.degrees(actual - estimated) + 180) % 360 - 180


def samples(s: Signals, reset=None, **drive) -> np.recarray:
    """What the front end makes of the signals for the observers, some parameters of the drive changed."""
    reset = np.zeros(s.tick.size, np.bool_) if reset is None else reset
    params = sample.make_params(TICK_HZ, own(sample, **drive))
    return sample.FrontEnd(params).run(s.measured, s.edges, reset).view(np.recarray)


def changed(records: np.recarray, **columns) -> np.recarray:
    """A copy with other columns; those of a record within by its name and theirs, with two underscores between."""
    copy = records.copy()
    for name, values in columns.items():
        inner, _, field = name.rpartition("__")
        (copy[inner] if inner else copy)[field] = values
    return copy


def run(observer, params, seen, reset=None, state=None):
    """State and estimates of an observer's module over samples, from `init` or from a state on."""
    entry = Entry.of(observer, "x", "a test's")
    at_work = Observing(entry, params)
    if state is not None:
        at_work.state.first = state
    estimates = at_work.run(seen, np.zeros(len(seen), np.bool_) if reset is None else reset)
    return at_work.state.first, estimates.view(np.recarray)


def estimate(observer, s: Signals, reset=None, **drive):
    """Estimates of an observer over the signals, some parameters of the drive changed."""
    return run(observer, observer.make_params(PWM_HZ, own(observer, **drive)), samples(s, reset, **drive), reset)[1]


def table(offsets_deg=TABLE_I, downwards_deg=None) -> dict[str, float]:
    """Drive parameters edge_up_*, edge_down_* for these offsets (deg, sectors I..VI)."""
    downwards_deg = offsets_deg if downwards_deg is None else downwards_deg
    return {
        f"edge_{way}_{s + 1}": float(np.radians(offsets[s]))
        for way, offsets in (("up", offsets_deg), ("down", downwards_deg))
        for s in range(6)
    }
