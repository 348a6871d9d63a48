"""Step 0, outputs off: what the current sensors show without a current, how they scatter, and the DC link voltage."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from bench.commission.meters import by_voltmeter
from bench.commission.outcome import Evidence, Outcome, Panel
from bench.commission.quantity import Quantity
from bench.commission.refusal import Refused
from bench.commission.stand import Stand
from bench.commission.window import Floats, Window
from bench.rig.envelope import Envelope

STEP = "offsets"
SECONDS = 0.3
FAR = 0.2
"""Share of the agreed current that an offset may be."""
NOISY = 0.1
"""Share of it that the noise may be."""
BLOCKS = 10


@dataclass(frozen=True)
class Offsets:
    """What a window with the outputs off shows."""

    offsets: Floats
    """A, shape (3,)."""
    noise: float
    """A, standard deviation of a sample, root mean square of the three sensors."""
    u_dc: float
    """V."""
    outcome: Outcome


def analyse(window: Window, i_max: float) -> Offsets:
    """Of a window with the outputs off; `i_max`, A: the agreed current, that offsets and noise are compared with.

    Refused where a sensor is stuck, noisy, or far off.
    """
    offsets = window.i.mean(axis=1)
    scatter = window.i.std(axis=1, ddof=1)
    noise = float(np.sqrt(np.mean(scatter**2)))
    for name, offset, sd in zip("abc", offsets, scatter, strict=True):
        if abs(offset) > FAR * i_max:
            raise Refused(
                STEP, f"current sensor {name} shows {offset:.3g} A with the outputs off, {FAR:.0%} of the agreed "
                f"{i_max:g} A are plausible: check the sensor, or whether somebody turns the shaft"
            )  # fmt: skip
        if sd > NOISY * i_max:
            raise Refused(
                STEP, f"current sensor {name} scatters by {sd:.3g} A, the agreed current is {i_max:g} A: nothing can "
                "be measured so; check the wiring, or agree to more current"
            )  # fmt: skip
    u_dc = float(window.u_dc.mean())
    if u_dc <= 0.0:
        raise Refused(STEP, f"the DC link voltage reads {u_dc:.3g} V: switch the supply on")
    n = len(window)
    blocks = window.u_dc[: n // BLOCKS * BLOCKS].reshape(BLOCKS, -1).mean(axis=1)
    found = [Quantity("u_dc", "V", u_dc, {"noise": float(blocks.std(ddof=1)) / math.sqrt(BLOCKS)}, volts=1.0)]
    for name, offset, sd in zip("abc", offsets, scatter, strict=True):
        found.append(Quantity(f"offset_{name}", "A", float(offset), {"noise": float(sd) / math.sqrt(n)}, amperes=0.0))
    found.append(Quantity("noise", "A", noise, {"noise": noise / math.sqrt(6.0 * n)}))
    t: Floats = 1e3 * window.T * np.arange(n, dtype=float)
    shown = slice(0, min(n, 800))
    currents = {f"phase {name}": (t[shown], np.asarray(window.i[k][shown])) for k, name in enumerate("abc")}
    panel = Panel("time", "ms", "current, outputs off", "A", currents)
    evidence = Evidence("Offsets and noise of the current sensors", (panel,), {"samples": float(n)})
    return Offsets(offsets, noise, u_dc, Outcome(tuple(found), evidence))


def perform(stand: Stand) -> Outcome:
    """Measure it on a drive at rest, and tell the stand."""
    stand.offsets = np.zeros(3)
    found = analyse(stand.run(SECONDS, "off"), stand.i_max)
    stand.offsets, stand.noise, stand.u_dc = found.offsets, found.noise, found.u_dc
    if stand.voltmeter is None:
        return found.outcome
    u_dc = found.outcome["u_dc"]
    stand.converters, remarks = by_voltmeter(STEP, u_dc.value, u_dc.sd, stand.voltmeter, stand.converters)
    return replace(found.outcome, remarks=tuple(remarks))


def announcement(agreed: Envelope) -> str:
    """What will be done, within what was agreed to."""
    return f"outputs off, {SECONDS:g} s: offsets and noise of the current sensors, DC link voltage"
