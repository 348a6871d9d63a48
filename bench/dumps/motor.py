"""The motor that a tool's configuration or a data sheet describes, as a configuration of the simulated drive.

Flux linkage psi_f (V s, amplitude of a phase) by what is given, with n_p pole pairs:

    KV, r/min by volt between terminals, peak    60 / (2 pi sqrt(3) n_p KV); by volt rms sqrt(2) times that
    ODrive's torque constant k_t, N m/A          k_t / (1.5 n_p): its guide has k_t = 8.27 / KV, the same for a peak
    moteus' Kv                                   30 / (2 pi n_p Kv): its v_per_hz is 30 / Kv, volt of a phase by Hz

VESC's foc_motor_r, foc_motor_l and foc_motor_flux_linkage are of a phase; its L_d and L_q lie half of
foc_motor_ld_lq_diff below and above foc_motor_l. ODrive's and moteus' resistance and inductance are of a phase, too.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from bench.dumps.read import MOTEUS, ODRIVE, VESC, Dump
from bench.errors import BenchError
from protocol.signals import DRIVE_PARAMETERS
from protocol.text import printable

SQRT3 = math.sqrt(3.0)
ALLOWED = {p.name: (p.lo, p.hi) for p in DRIVE_PARAMETERS}
L_BY_R = 0.8e-3
"""s, inductance by resistance of a phase where none is given: the ten motors that are shipped have 0.4 to 1.5 ms."""
TAU = (20e-6, 0.1)
"""s, which L / R of motors lies between: slotless ones have some 50 us."""
U_DC = 24.0
STEP = 1.0 / 16_000
"""s, PWM period of the simulated drive, and its integration step unless it takes several: no L / R may be shorter."""
DEAD, MOST_SMOOTH = 0.016, 10.0
"""Of the DC link, that its dead time loses; A, below which that may shrink at most: a step may not change more."""


class Likely(NamedTuple):
    """What a motor on a bench has; what is beyond is more likely in another unit."""

    what: str
    unit: str
    least: float
    most: float
    others: tuple[tuple[str, float], ...] = ()
    """Units that it may be in, with their size in `unit`."""


LIKELY = {
    "poles": Likely("magnet poles", "", 2, 128),
    "R_s": Likely("resistance of a phase", "ohm", 5e-4, 60.0, (("milliohm", 1e-3), ("microohm", 1e-6))),
    "L_d": Likely("inductance of a phase", "H", 1e-6, 0.05, (("microhenry", 1e-6), ("mH", 1e-3))),
    "L_q": Likely("inductance of a phase", "H", 1e-6, 0.05, (("microhenry", 1e-6), ("mH", 1e-3))),
    "psi_f": Likely("flux linkage", "V s", 2e-4, 0.6, (("mWb", 1e-3), ("microweber", 1e-6))),
    "i_max": Likely("largest phase current", "A", 0.05, ALLOWED["i_max"][1], (("mA", 1e-3),)),
    "u_dc": Likely("DC link voltage", "V", 5.0, 63.9, (("mV", 1e-3),)),
}


@dataclass(frozen=True)
class Given:
    """What somebody says of the motor; it goes before what a file says. None: nothing."""

    kv: float | None = None
    """r/min by volt between terminals."""
    kv_rms: bool = False
    """Whether that volt is rms, not peak."""
    resistance: float | None = None
    """ohm."""
    of_phase: bool = False
    """Whether resistance and inductance are those of a phase, not between two terminals."""
    inductance: float | None = None
    """H."""
    poles: int | None = None
    current: float | None = None
    """A, amplitude."""
    voltage: float | None = None


@dataclass(frozen=True)
class Motor:
    """What the simulated drive needs to know, SI units, of a phase."""

    n_p: int
    R_s: float
    L_d: float
    L_q: float
    psi_f: float
    i_max: float
    u_dc: float
    source: str
    notes: tuple[str, ...] = ()
    """What was taken for granted, and what the other reading would give."""

    @property
    def kv(self) -> float:
        """r/min by volt between terminals, peak."""
        return 60.0 / (math.tau * SQRT3 * self.n_p * self.psi_f)

    def as_json(self) -> dict[str, object]:
        """Plain data."""
        return {**vars(self), "notes": list(self.notes), "kv": self.kv, "torque_constant": 1.5 * self.n_p * self.psi_f}

    def toml(self) -> str:
        """The configuration of the simulated drive."""
        steepest = max(self.R_s, DEAD * self.u_dc / (2.0 * MOST_SMOOTH))
        substeps = math.ceil(1.01 * STEP * steepest / min(self.L_d, self.L_q))
        rows = {
            "n_p": (self.n_p, "pole pairs"),
            "R_s": (self.R_s, "ohm, of a phase"),
            "L_d": (self.L_d, "H"),
            "L_q": (self.L_q, "H"),
            "psi_f": (self.psi_f, f"V s; KV is {self.kv:.4g} r/min by volt, peak between terminals"),
            "i_max": (self.i_max, "A, amplitude"),
        }
        lines = [f"# {printable(line)}" for line in (f"Motor: {self.source}", *self.notes)]
        lines += ["", "[motor]", *(f"{name} = {value!r} # {about}" for name, (value, about) in rows.items())]
        lines += ["", "[inverter]", f"u_dc = {self.u_dc!r} # V"]
        if substeps > 1:
            lines += ["", "[clock]", f"substeps = {substeps} # a current can change a lot in a PWM period"]
        return "\n".join([*lines, ""])


def rows(motor: Motor) -> list[list[str]]:
    """Names and values."""
    return [
        ["pole pairs", f"{motor.n_p}"],
        ["R_s", f"{motor.R_s:.4g} ohm, of a phase"],
        ["L_d, L_q", f"{1e6 * motor.L_d:.4g}, {1e6 * motor.L_q:.4g} microhenry, of a phase"],
        ["psi_f", f"{1e3 * motor.psi_f:.4g} mV s"],
        ["KV", f"{motor.kv:.4g} r/min by volt, peak between terminals"],
        ["torque constant", f"{1.5 * motor.n_p * motor.psi_f:.4g} N m/A, amplitude of the phase current"],
        ["largest current", f"{motor.i_max:g} A, amplitude"],
        ["DC link", f"{motor.u_dc:g} V"],
    ]


def lacking(dump: Dump | None, given: Given) -> list[str]:
    """The fields of `Given` without which there is no motor, and which neither of the two has."""
    said = _said(dump, given)
    here = {"poles": "poles", "resistance": "R_s", "kv": "psi_f", "current": "i_max"}
    return [name for name, of in here.items() if getattr(given, name) is None and of not in said]


def described(dump: Dump | None, given: Given) -> Motor:
    """The motor. BenchError, with the value, for what is missing, out of range, or hardly in that unit."""
    notes = [] if dump is None else list(dump.notes)
    said = _said(dump, given)
    n_p = _pole_pairs(said["poles"]) if "poles" in said else 0
    if missing := lacking(dump, given):
        without = "without a FILE" if dump is None else f"{dump.path} does not say it:"
        raise BenchError(f"{without} a motor needs {', '.join(f'--{name}' for name in missing)}")
    whose = "the data sheet" if dump is None else f"{dump.tool}, {dump.path.name}"
    _take_electrical(said, given, notes)
    notes += _unmeasured(said)
    psi_f = _flux(said, given, n_p, notes)
    likely("psi_f", psi_f)
    R_s, i_max = said["R_s"], said["i_max"] if given.current is None else given.current
    u_dc = _voltage(said, given, notes)
    for name, value in (("R_s", R_s), ("L_d", said["L_d"]), ("L_q", said["L_q"]), ("i_max", i_max)):
        likely(name, value)
    tau = min(said["L_d"], said["L_q"]) / R_s
    if not TAU[0] <= tau <= TAU[1]:
        raise BenchError(
            f"{said['L_d']:.4g} H by {R_s:.4g} ohm are {tau:.2g} s, and motors have {TAU[0]:g} to {TAU[1]:g} s: "
            "check the units of inductance and resistance"
        )
    if 0.5 * i_max * R_s >= 0.95 * u_dc / SQRT3:
        raise BenchError(
            f"{i_max:g} A are too much for {R_s:.4g} ohm of a phase: half of them take {0.5 * i_max * R_s:.3g} V, and "
            f"of a DC link of {u_dc:g} V a phase gets {u_dc / SQRT3:.3g} V: check the units, --current and --voltage"
        )
    R_s, L_d, L_q, psi_f, i_max, u_dc = (
        float(f"{value:.6g}") for value in (R_s, said["L_d"], said["L_q"], psi_f, i_max, u_dc)
    )
    return Motor(n_p, R_s, L_d, L_q, psi_f, i_max, u_dc, whose, tuple(notes))


def likely(name: str, value: float, half: float = 1.0) -> None:
    """BenchError where a motor on a bench hardly has `half` that value; with the unit that it may be in."""
    what, unit, least, most, others = LIKELY[name]
    if least <= half * value <= most:
        return
    said = f"{what}{' (two of them)' if half != 1.0 else ''}: {value:g} {unit}".rstrip()
    if not value > 0.0:
        raise BenchError(f"{said}: it must be above 0")
    for other, size in others:
        if least <= half * value * size <= most:
            raise BenchError(f"{said}; is it in {other}? Then give {value * size:.4g} {unit}")
    raise BenchError(f"{said}: {least / half:g} to {most / half:g} {unit} can be simulated".replace("  ", " "))


FIELDS: dict[str, dict[str, tuple[str, ...]]] = {
    VESC: {
        "poles": ("si_motor_poles",), "R_s": ("foc_motor_r",), "L": ("foc_motor_l",),
        "apart": ("foc_motor_ld_lq_diff",), "psi_f": ("foc_motor_flux_linkage",),
        "i_max": ("l_current_max",), "u_most": ("l_max_vin",),
    },
    ODRIVE: {
        "pairs": ("config.motor.pole_pairs", "motor.config.pole_pairs"),
        "R_s": ("config.motor.phase_resistance", "motor.config.phase_resistance"),
        "L": ("config.motor.phase_inductance", "motor.config.phase_inductance"),
        "k_t": ("config.motor.torque_constant", "motor.config.torque_constant"),
        "i_max": ("config.motor.current_soft_max", "motor.config.current_lim"),
    },
    MOTEUS: {
        "poles": ("motor.poles",), "R_s": ("motor.resistance_ohm",), "L_d": ("motor.inductance_d_H",),
        "L_q": ("motor.inductance_q_H",), "kv": ("motor.Kv",), "v_per_hz": ("motor.v_per_hz",),
        "i_max": ("servo.max_current_A",), "u_most": ("servo.max_voltage",),
    },
}  # fmt: skip
"""What a tool calls what is needed, its newer name first. `k_t` is in N m/A, `v_per_hz` by turn of the shaft."""
INSTEAD = {
    "poles": "poles", "pairs": "poles", "R_s": "resistance", "L": "inductance", "apart": "inductance",
    "L_d": "inductance", "L_q": "inductance", "psi_f": "kv", "k_t": "kv", "kv": "kv", "v_per_hz": "kv",
    "i_max": "current",
}  # fmt: skip
"""What of `Given` goes before it: then it is not looked at."""


def _said(dump: Dump | None, given: Given) -> dict[str, float]:
    """What a file says of poles, R_s, L_d, L_q, psi_f, i_max and u_most, as far as `given` does not."""
    said: dict[str, float] = {}
    for field, names in FIELDS[dump.tool].items() if dump is not None else ():
        if dump is not None and (field not in INSTEAD or getattr(given, INSTEAD[field]) is None):
            value = (dump.whole if field in ("poles", "pairs") else dump.number)(*names)
            said |= {} if value is None else {field: float(value)}
    if "pairs" in said:
        said["poles"] = 2.0 * said["pairs"]
    if given.poles is not None:
        said["poles"] = given.poles
    if "L" in said:
        half = 0.5 * said.get("apart", 0.0)
        said |= {"L_d": said["L"] - half, "L_q": said["L"] + half}
    if said.get("kv"):
        said["v_per_hz"] = 30.0 / said["kv"]
    n_p = 0.5 * said.get("poles", 0.0)
    if n_p > 0.0 and "k_t" in said:
        said["psi_f"] = said["k_t"] / (1.5 * n_p)
    if n_p > 0.0 and "v_per_hz" in said:
        said["psi_f"] = said["v_per_hz"] / (math.tau * n_p)
    return said


def _unmeasured(said: Mapping[str, float]) -> Iterator[str]:
    """Values that a tool has before anything is measured or set. BenchError where one is no motor's."""
    if said.get("k_t") == 1.0:
        raise BenchError("torque_constant = 1 has the ODrive take torques in A: it is not the motor's; give --kv")
    if math.isclose(said.get("k_t", 0.0), 0.04, rel_tol=1e-6):
        yield "a torque constant of 0.04 N m/A is what an ODrive has before one is set: is it the motor's?"
    default = {"R_s": 0.015, "L_d": 7e-6, "psi_f": 0.00245}
    if all(math.isclose(said.get(name, 0.0), value, rel_tol=1e-3) for name, value in default.items()):
        yield "0.015 ohm, 7 microhenry and 2.45 mWb are what a VESC has before it measures: was the motor detected?"


def _odrive(name: str) -> tuple[str, str]:
    """A name of its 0.6 and of its 0.5."""
    return f"config.motor.{name}", f"motor.config.{name}"


def _pole_pairs(poles: float) -> int:
    likely("poles", poles)
    if poles % 2:
        raise BenchError(f"{poles:g} magnet poles: a motor has as many north as south poles; is it pole pairs?")
    return int(poles) // 2


def _take_electrical(said: dict[str, float], given: Given, notes: list[str]) -> None:
    """Put R_s, L_d and L_q of a phase into what is said."""
    half = 1.0 if given.of_phase else 0.5
    if given.resistance is not None:
        likely("R_s", given.resistance, half)
        said["R_s"] = half * given.resistance
    if given.inductance is not None:
        likely("L_d", given.inductance, half)
        said["L_d"] = said["L_q"] = half * given.inductance
    given_any = given.resistance is not None or given.inductance is not None
    if given_any and not given.of_phase:
        notes.append("resistance and inductance that were given are between two terminals: a phase has half (--phase)")
    likely("R_s", said["R_s"])
    found = [said[name] for name in ("L_d", "L_q") if said.get(name)]
    said |= {name: said.get(name) or (found or [L_BY_R * said["R_s"]])[0] for name in ("L_d", "L_q")}
    if not found:
        notes.append(f"no inductance was given: {1e3 * L_BY_R:g} ms times the resistance is assumed (--inductance)")


def _flux(said: dict[str, float], given: Given, n_p: int, notes: list[str]) -> float:
    if given.kv is None:
        return said["psi_f"]
    if not 0.1 <= given.kv <= 50_000:
        raise BenchError(f"--kv {given.kv:g} r/min by volt: 0.1 to 50000 can be")
    peak = 60.0 / (math.tau * SQRT3 * n_p * given.kv)
    rms = peak * math.sqrt(2.0)
    took, other, flux, else_ = ("rms", "peak", rms, peak) if given.kv_rms else ("peak", "rms", peak, rms)
    notes.append(f"KV is by volt {took} between terminals; by volt {other} the flux linkage would be {else_:.4g} V s")
    return flux


def _voltage(said: dict[str, float], given: Given, notes: list[str]) -> float:
    u_dc, most = U_DC if given.voltage is None else given.voltage, said.get("u_most", math.inf)
    if given.voltage is None:
        u_dc = min(u_dc, most) if most > 0.0 else u_dc
        notes.append(f"a DC link of {u_dc:g} V is assumed (--voltage)")
    elif u_dc > most:
        notes.append(f"the DC link has {u_dc:g} V, and the file allows {most:g} V")
    likely("u_dc", u_dc)
    return u_dc
