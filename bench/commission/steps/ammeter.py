"""What an ammeter in a phase reads while the drive holds a current there: the common gain of the current sensors.

The current is a d current at the angle at which one phase has all of it, after the resistance's step, by which the
three sensors are known beside their mean. A person reads the instrument meanwhile, and types it in once it is over.
"""

from __future__ import annotations

import math

import numpy as np

from bench.commission.meters import Reading, by_ammeter
from bench.commission.outcome import Evidence, Outcome, Panel
from bench.commission.quantity import Quantity
from bench.commission.refusal import Refused
from bench.commission.stand import Stand
from bench.rig.envelope import Envelope

STEP = "ammeter"
ANGLES = {"a": 0.0, "b": 2.0 * math.pi / 3.0, "c": -2.0 * math.pi / 3.0}
"""At which this phase has all of the current."""
SHARE = 0.5
"""Of the agreed current: a quarter of its heat, for as long as it takes to read an instrument."""
LOOK = 0.2
"""s of a look at the current, before and after the instrument is read, and at the offset before that."""
STEADY = 0.003
"""Share by which it may change meanwhile."""
SHOWN = 1000
"""Points of a curve."""


def perform(stand: Stand) -> Outcome:
    """Hold it, ask for the reading, and tell the stand what follows. Refused where the current does not stay."""
    asked = stand.ammeter
    assert asked is not None
    phase = "abc".index(asked.phase)
    offset = float(stand.run(LOOK, "off").i[phase].mean())
    with stand.running():
        stand.turn_to(ANGLES[asked.phase])
        stand.ramp(0.05 * stand.i_max, SHARE * stand.i_max, 0.3)
        stand.wait(0.5)
        windows = [stand.run(LOOK, "forced")]
        stand.rig.ask(f"read the ammeter in phase {asked.phase}, about {SHARE * stand.i_max:.3g} A")
        windows.append(stand.run(LOOK, "forced"))
        stand.current(0.0)
        stand.wait(0.02)
    before, after = (float(window.i[phase].mean()) - offset for window in windows)
    if not abs(after - before) < STEADY * abs(before):
        raise Refused(STEP, f"the current went from {before:.4g} to {after:.4g} A while the ammeter was read")
    read = Reading(abs(asked.read(f"ammeter in phase {asked.phase}, A")), asked.accuracy)
    if read.value == 0.0:
        raise Refused(STEP, f"the ammeter reads 0 A, and {before:.3g} A flow: it is not in phase {asked.phase}")
    gain = stand.found[f"gain_{asked.phase}"]
    own = 0.5 * (before + after) / gain.value
    scatter = stand.noise * math.sqrt(1.5 / len(windows[0]))  # of two looks, and of that at the offset
    sd = math.hypot(scatter, 0.5 * (after - before), own * gain.sd)
    stand.converters, remarks = by_ammeter(STEP, own, sd, read, stand.converters)
    held = Quantity("i_held", "A", own, {"noise": sd}, amperes=1.0)
    every = max(1, len(windows[0]) // SHOWN)
    shown = {
        name: (1e3 * window.T * np.arange(0.0, len(window), every), window.i[phase][::every] - offset)
        for name, window in zip(("before it was read", "after it"), windows, strict=True)
    }
    panel = Panel("time", "ms", f"current in phase {asked.phase}", "A", shown)
    evidence = Evidence("A current held for an ammeter", (panel,), {
        "read": read.value, "accuracy": read.accuracy, "drive": own, "before": before, "after": after,
    })  # fmt: skip
    return Outcome((held,), evidence, tuple(remarks))


def announcement(agreed: Envelope) -> str:
    """What will be done, within what was agreed to."""
    return (
        f"{SHARE * agreed.current:.3g} A flow in one phase until you have read the ammeter there; the shaft moves to "
        "an angle and stays"
    )
