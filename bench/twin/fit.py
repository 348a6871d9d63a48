"""`bench twin fit`: from recordings to a configuration of the simulated drive, with what it leaves unexplained."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bench.commission.quantity import Quantity
from bench.commission.window import Floats
from bench.errors import BenchError
from bench.files import leaves, read_toml
from bench.record.layout import EDGES
from bench.record.reader import Run
from bench.twin import shaft as of_shaft
from bench.twin import winding as of_winding
from bench.twin.halls import Halls, halls
from bench.twin.known import known
from bench.twin.samples import Stretch, stretches
from bench.twin.values import Number, Value, as_json, several, single, toml
from protocol import __version__
from sim.ports.direct import nominal

FLOORS = {
    "R_s": (3e-3, 8e-3), "L_d": (8e-3, 4e-2), "L_q": (4e-3, 3e-2), "psi_f": (1e-3, 4e-3), "dead_time": (5e-3, 6e-2),
    "i_smooth": (2e-2, 0.2), "J": (3.5e-3, 3.5e-3), "b": (6e-3, 6e-3), "tau_coulomb": (6e-3, 6e-3),
}  # fmt: skip
"""Of each, sd: what the method leaves where noise explains all that is left of the voltages, and where they are left
with much more: by saturation, or a dead time of another shape."""
MUCH = 1.7
"""Times noise, that much more is."""
ZERO_FLOOR, DELAY_FLOOR, GAIN_FLOOR, HARMONIC_FLOOR = math.radians(0.02), 1e-6, 2.3e-3, 3e-4
"""rad, s, and shares, sd, likewise."""
POWERS = {
    "R_s": (1, -1), "L_d": (1, -1), "L_q": (1, -1), "psi_f": (1, 0), "i_smooth": (0, 1), "J": (1, 1), "b": (1, 1),
    "tau_coulomb": (1, 1), "cogging": (1, 1),
}  # fmt: skip
"""With which volts and amperes enter."""
SECTIONS = {
    "R_s": "motor", "L_d": "motor", "L_q": "motor", "psi_f": "motor", "dead_time": "inverter", "i_smooth": "inverter",
    "J": "mechanics", "b": "mechanics", "tau_coulomb": "mechanics",
}  # fmt: skip
UNITS = {
    "R_s": "ohm", "L_d": "H", "L_q": "H", "psi_f": "V s", "dead_time": "s", "i_smooth": "A", "J": "kg m2",
    "b": "N m s/rad", "tau_coulomb": "N m",
}  # fmt: skip
COGGING_FLOOR, LATE_FLOOR = 5e-4, 1e-7
"""Of the rated torque; s, sd."""
MOST = 3_000_000
"""Samples, about: three minutes at 16 kHz."""
MOST_STEPS = 100
"""In a PWM period, of the simulated drive's integration."""
SURE = 3.0
"""Standard deviations, beyond which an encoder, or a current, is believed to be late."""
DROPS = "dead_time and u_device, the drop of the switches: only what both take together; u_device is as it was before"
LEARNED = "dead_time: the drive has learned and compensated what its parameters leave of it (dead_time_learn = 1)"
GAINS = "the gain of the DC link's voltage, and the common gain of the currents: nothing tells them from inside"


@dataclass
class Twin:
    """A configuration of the simulated drive, and how well it explains the recordings."""

    values: dict[str, Number]
    """All that differs from the simulated drive's default, by dotted key."""
    told: list[Value] = field(default_factory=list)
    """Those that the recordings told, with intervals."""
    residuals: dict[str, tuple[float, str]] = field(default_factory=dict)
    """By channel or equation: what is left, and its unit."""
    untold: list[str] = field(default_factory=list)
    """What the recordings do not tell, in words."""
    runs: tuple[str, ...] = ()

    @property
    def quantities(self) -> list[Quantity]:
        """All that were told."""
        return [one for value in self.told for one in value.told]

    def __getitem__(self, name: str) -> Quantity:
        """A quantity by its name, such as `motor.R_s`; KeyError where it was not told."""
        return {one.name: one for one in self.quantities}[name]

    def toml(self) -> str:
        """The configuration, values with their intervals as comments."""
        left = [f"left by {name}: {value:.3g} {unit}" for name, (value, unit) in self.residuals.items()]
        head = [
            f"A twin of {', '.join(self.runs)}, by hallbench {__version__}: bench sim --config this-file.toml", *left,
            *(f"not told: {words}" for words in self.untold),
        ]  # fmt: skip
        return toml(self.values, {value.key: value.comment for value in self.told}, head)

    def as_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "runs": list(self.runs), "values": self.values, "quantities": as_json(self.quantities),
            "residuals": [{"of": k, "rms": v, "unit": unit} for k, (v, unit) in self.residuals.items()],
            "not_told": self.untold,
        }  # fmt: skip


def fit(runs: Sequence[Run], config: Path | None = None) -> Twin:
    """Fit a twin to recordings of one drive, beginning with the configuration `config`, or with the drive's parameters.

    BenchError where the recordings hold nothing to fit, and for a configuration that the simulated drive refuses.
    """
    base: dict[str, Number] = {}
    if config is not None:
        nominal(config, {})  # whose errors name the file
        base = dict(leaves(read_toml(config, "configuration")))
    pieces, more = _read(runs)
    base = known(runs, pieces) | base
    _fine_steps(base)
    figures = nominal(None, base)
    twin = Twin(base, runs=tuple(run.path.name for run in runs))
    if more:
        twin.untold.append(f"what comes after the first {MOST} samples: of them winding and shaft are not fitted")
    found = _electrical(twin, pieces, figures)
    if found is not None:
        _mechanical(twin, pieces, found, figures)
    edges = _edges(twin, runs, found)
    if found is None and edges is None:
        raise BenchError(f"{', '.join(twin.runs)}: nothing can be fitted: {'; '.join(twin.untold)}")
    twin.untold = list(dict.fromkeys(twin.untold))
    twin.values |= {value.key: value.value for value in twin.told}
    _fine_steps(twin.values)
    nominal(None, twin.values)  # that the simulated drive takes it
    return twin


def _read(runs: Sequence[Run]) -> tuple[list[Stretch], bool]:
    """Stretches of `MOST` samples in all, and whether there are more."""
    pieces: list[Stretch] = []
    n = 0
    for piece in (piece for run in runs for piece in stretches(run)):
        if n >= MOST:
            return pieces, True
        pieces.append(piece)
        n += len(piece)
    return pieces, False


def _fine_steps(values: dict[str, Number]) -> None:
    """Integration steps that are short enough for these figures, and for what follows from them."""
    figures = nominal(None, values | {"clock.substeps": MOST_STEPS})
    motor, inverter, pwm_hz = figures["motor"], figures["inverter"], figures["clock"]["pwm_hz"]
    L, lost = min(motor["L_d"], motor["L_q"]), inverter["u_dc"] * inverter["dead_time"] * pwm_hz + inverter["u_device"]
    steps = math.ceil(max(motor["R_s"] / L, lost / (2.0 * L * inverter["i_smooth"])) / pwm_hz / 0.9)
    if steps > values.get("clock.substeps", 1):
        values["clock.substeps"] = steps


def _electrical(twin: Twin, pieces: Sequence[Stretch], figures: Mapping[str, Any]) -> of_winding.Winding | None:
    motor = figures["motor"]
    start = of_winding.Start(
        motor["R_s"], motor["L_d"], motor["L_q"], motor["psi_f"], figures["inverter"]["dead_time"],
        figures["inverter"]["i_smooth"], motor["emf_harmonics"],
    )  # fmt: skip
    if why := _lacks(pieces):
        twin.untold.append(f"winding, inverter, shaft: {why}")
        return None
    offset, noise = _at_rest(twin, pieces, figures)
    own = figures["current_sensor"]["noise_rms"] if noise is None else noise
    found = of_winding.winding(pieces, start, offset, own)
    if found is None:
        twin.untold.append("winding, inverter, shaft: the outputs were hardly on")
        return None
    beyond = found.residual / _expected(found, figures, own)
    kept = {"dead_time"} if any(p.parameters.get("dead_time_learn") for p in pieces) else set()
    twin.untold += [LEARNED] if kept else []
    for name, section in SECTIONS.items():
        if name not in of_winding.NAMES or name in kept:
            continue
        twin.values[f"{section}.{name}"] = max(found[name], 0.0)  # also of what is told of several together only
        if found.known(name):
            least, most = FLOORS[name]
            floor = least + (most - least) * min(1.0, max(0.0, (beyond**2 - 1.0) / (MUCH**2 - 1.0)))
            parts = found.parts(name, floor * abs(found[name]))
            twin.told.append(_value(section, name, found[name], parts))
    _harmonics(twin, found)
    _sensors(twin, found)
    twin.untold += [_words(names) for names in found.told.untold]
    twin.residuals["voltage equation, a millisecond's mean"] = (found.residual, "V")
    if noise is not None:
        twin.residuals["currents at rest"] = (noise, "A")
    return found


def _expected(found: of_winding.Winding, figures: Mapping[str, Any], noise: float) -> float:
    """V rms that noise of the currents and steps of the encoder leave of the voltages."""
    count = math.tau * figures["motor"]["n_p"] / (4.0 * figures["encoder"]["pulses_per_rev"])
    flux = found["L_q"] * noise * math.sqrt(8.0 / 3.0), found["psi_f"] * count / math.sqrt(6.0)
    return 1.2 * math.hypot(*flux) / of_winding.SPAN


def _lacks(pieces: Sequence[Stretch]) -> str:
    for name, there in (
        ("currents (i_a, i_b)", [p.i is not None for p in pieces]),
        ("voltages (u_alpha, u_beta, u_dc)", [p.u is not None and p.u_dc is not None for p in pieces]),
        ("encoder (theta_enc)", [p.theta is not None for p in pieces]),
    ):
        if not any(there):
            return f"no {name} recorded"
    return "" if any(p.every for p in pieces) else "samples of every PWM period are needed: record at the full rate"


def _at_rest(twin: Twin, pieces: Sequence[Stretch], figures: Mapping[str, Any]) -> tuple[Floats, float | None]:
    """Offsets, A, (3,), and noise of the current sensors, while no current flows."""
    sensor = figures["current_sensor"]
    rest = np.concatenate([p.i[:, p.rest] for p in pieces if p.i is not None], axis=1)
    if rest.shape[1] < 100:
        twin.untold.append("offsets and noise of the current sensors: the outputs were never off for long enough")
        return np.asarray(sensor["offset"], float), None
    offset, noise = rest.mean(axis=1), float(np.sqrt(np.mean(rest.std(axis=1) ** 2)))
    step = sensor["range"] / 2.0 ** (sensor["bits"] - 1)
    own = math.sqrt(max(noise**2 - step**2 / 12.0, 0.0))
    of_mean = {"noise": noise / math.sqrt(rest.shape[1]), "steps": step / 12.0}
    of_noise = {"noise": noise / math.sqrt(2.0 * rest.size), "steps": step / 12.0}
    twin.told += [
        several("current_sensor.offset", "A", offset, [of_mean] * 3, (0, 1), "abc"),
        single("current_sensor.noise_rms", "A", own, of_noise, (0, 1)),
    ]
    return offset, noise


def _value(section: str, name: str, value: float, parts: Mapping[str, float]) -> Value:
    return single(f"{section}.{name}", UNITS[name], max(value, 0.0), parts, POWERS.get(name, ()))


def _harmonics(twin: Twin, found: of_winding.Winding) -> None:
    names = [f"emf_harmonic_{order}" for order in of_winding.ORDERS]
    if any(map(found.known, names)):
        values = [found[name] for name in names]
        parts = [found.parts(name, HARMONIC_FLOOR) if found.known(name) else None for name in names]
        twin.told.append(several("motor.emf_harmonics", "", values, parts))


def _sensors(twin: Twin, found: of_winding.Winding) -> None:
    """The encoder's place and delay, and how the gains of the current sensors differ."""
    if found.known("encoder_zero"):
        degrees = math.degrees(math.remainder(found["encoder_zero"], math.tau))
        parts = {cause: math.degrees(sd) for cause, sd in found.parts("encoder_zero", ZERO_FLOOR).items()}
        twin.told.append(single("encoder.offset_deg", "deg", degrees, parts))
    if late := delay(found):
        parts = found.parts("encoder_delay", DELAY_FLOOR)
        twin.told.append(single("encoder.latency", "s", late, parts))
    if found.known("gain_a") and found.known("gain_b"):
        a, b = found.parts("gain_a", GAIN_FLOOR), found.parts("gain_b", GAIN_FLOOR)
        mean = {cause: math.hypot(a[cause], b[cause]) / math.sqrt(2.0) for cause in a}
        twin.told.append(several("current_sensor.gain_error", "", found.gains(), [a, b, mean]))
    twin.untold += [GAINS, DROPS]


def delay(found: of_winding.Winding) -> float:
    """s by which the encoder is late; 0 where that is not beyond doubt."""
    late = found["encoder_delay"]
    return late if late > SURE * math.hypot(*found.parts("encoder_delay", DELAY_FLOOR).values()) else 0.0


def _mechanical(twin: Twin, pieces: Sequence[Stretch], found: of_winding.Winding, figures: Mapping[str, Any]) -> None:
    motor, shaft = figures["motor"], figures["mechanics"]
    torque = 1.5 * motor["n_p"] * motor["psi_f"] * motor["i_max"]
    start = of_shaft.Start(shaft["J"], shaft["b"], shaft["tau_coulomb"], motor["cogging"])
    told = of_shaft.shaft(pieces, start, found, motor["n_p"], torque)
    if told is None:
        twin.untold.append("J, b, tau_coulomb, cogging: the shaft hardly turned")
        return
    share = found.sd("psi_f") / found["psi_f"]
    x, late = told.told, told.told.known[of_shaft.LATE]
    for k, name in enumerate(of_shaft.NAMES[:3]):
        twin.values[f"mechanics.{name}"] = max(float(x.x[k]), 0.0)
        if x.known[k]:
            size = abs(float(x.x[k]))
            parts = {
                "noise": float(x.sd[k]), "psi": share * size, "method": FLOORS[name][0] * size,
                "shape": float(told.shape[k]),
            }  # fmt: skip
            if name == "b" and not late:
                parts["late currents"] = told.late_as_b * of_shaft.USUAL_LATE
            twin.told.append(_value("mechanics", name, float(x.x[k]), parts))
    if any(x.known[3:5]):
        parts_of = [
            {"noise": float(x.sd[k]), "method": COGGING_FLOOR * torque, "shape": float(told.shape[k])}
            if x.known[k] else None for k in (3, 4)
        ]  # fmt: skip
        twin.told.append(several("motor.cogging", "N m", x.x[3:5], parts_of, POWERS["cogging"]))
    own = {"noise": float(x.sd[of_shaft.LATE]), "method": LATE_FLOOR, "shape": float(told.shape[of_shaft.LATE])}
    if late and x.x[of_shaft.LATE] > SURE * math.hypot(*own.values()):
        twin.told.append(single("current_sensor.delay", "s", min(float(x.x[of_shaft.LATE]), 2e-5), own))
    twin.untold += [_words(names) for names in x.untold]
    if not told.loaded:
        twin.untold.append("a load's torque: none was recorded, and none is taken to have acted")
    twin.residuals["torque, 50 ms' mean"] = (told.residual, "N m")


def _words(names: Sequence[str]) -> str:
    if names == ("L_d",):
        return "L_d apart from L_q: nothing in the recordings tells it; their ratio is as it was before"
    if len(names) == 1:
        return f"{names[0]}: nothing in the recordings tells it; it is as it was before"
    return f"{' and '.join(names)}: the recordings tell only what they do together; what tells them apart is as before"


def _edges(twin: Twin, runs: Sequence[Run], found: of_winding.Winding | None) -> Halls | None:
    """Of the run with the most Hall edges."""
    best = max(runs, key=lambda run: run.rows(EDGES) if EDGES in run.names else 0)
    zero, sd, late = best.parameters.get("encoder_zero", 0.0), 0.0, 0.0
    if found is not None:
        zero, late = zero + found["encoder_zero"], delay(found)
        sd = math.hypot(*found.parts("encoder_zero", ZERO_FLOOR).values())
    told = halls(best, zero, sd, late)
    if isinstance(told, str):
        twin.untold.append(f"Hall sensors: {told}")
        return None
    twin.told += told.values
    twin.untold += told.untold
    if not told.blind and (found is None or not found.known("encoder_zero")):
        twin.untold.append("where the encoder's zero lies: hall.offset_deg is by the encoder as it is")
    twin.residuals["Hall edges"] = (told.residual, "deg")
    twin.residuals["Hall edges, as their times and angles are resolved"] = (told.resolution, "deg")
    if "motor.n_p" not in twin.values and told.n_p:
        twin.values["motor.n_p"] = told.n_p
    return told
