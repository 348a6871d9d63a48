"""What the dragged turn leaves open where there is no encoder: pole pairs, and a drive that runs on Hall sensors."""

from __future__ import annotations

import numpy as np

from bench.commission.analysis.hall_order import HallOrder
from bench.commission.quantity import Quantity
from bench.commission.refusal import Refused
from bench.commission.stand import Stand
from bench.findings.wiring import hats
from bench.rig.needs import offers
from bench.signal.waveforms.sectors import SECTORS, steps_between

STEP = "pole pairs"
SOURCES = ("lookup-table", "average-speed")
"""Angle sources that need no parameter of the motor, best first: the first knows where each edge lies."""
NEAR = 0.25
"""Electrical turns, by which what was counted by hand may differ from a whole number."""
TRIES = 3
"""Times that a person is asked."""
QUIET = 0.1
"""s after Enter, for edges that are under way."""


def run_on_halls(stand: Stand, order: HallOrder, psi: float) -> dict[str, float]:
    """Of a drive at rest: have it run on its Hall sensors as they are wired; the parameters of the wiring.

    `psi`: V s, rough, by which a drive may compare the Hall sensors with the back-EMF. Refused where it lacks what it
    takes.
    """
    assert order.wired is not None
    assert order.edges is not None
    node, now = stand.rig.drive.node, stand.rig.drive.parameters
    swap, inverted = hats(order.wired, int(now.get("hall_swap_hat", 0)), int(now.get("hall_invert_hat", 0)))
    wiring = {"hall_swap_hat": swap, "hall_invert_hat": inverted}
    ring = {"hall_offset": order.edges.ring.value}
    lacks = [name for name, value in (wiring | ring).items() if value and not node.has_parameter(name)]
    source = next((name for name in SOURCES if offers(node, name)), None)
    if lacks or source is None:
        what = f"parameter {lacks[0]}" if lacks else f"angle source {' or '.join(SOURCES)}"
        raise Refused("spin", f"the drive has no {what}: it cannot run on these Hall sensors")
    edges = {each.name: each.value for each in (*order.edges.up, *order.edges.down)}
    stand.set(**wiring, **ring, **edges, psi_f_hat=psi)
    stand.rig.drive.observe(source)
    return wiring


def counted_by_hand(stand: Stand) -> Quantity:
    """Electrical turns in one of the shaft, which a person turns by hand with the outputs off; name `n_p`.

    Of a drive whose Hall codes are in order. Refused where they are no whole number each time.
    """
    told = "turn the shaft by hand by exactly one turn, from a mark to the same mark, in either direction"
    counts: list[float] = []
    for _ in range(TRIES):
        first = stand.rig.tick()
        stand.rig.ask(told if not counts else f"{counts[-1]:.2f} electrical turns were counted; {told}")
        stand.rig.wait(QUIET)
        edges = stand.rig.between(first, stand.rig.recorder.newest).edges
        steps = steps_between(edges.hall_old, edges.hall_new)
        counts.append(abs(float(np.sum(steps))) / SECTORS)
        near = round(counts[-1])
        if near >= 1 and abs(counts[-1] - near) <= NEAR:
            return Quantity("n_p", "", counts[-1], {"a sector": 1.0 / SECTORS})
    every = ", ".join(f"{count:.2f}" for count in counts)
    raise Refused(
        STEP, f"not claimed: one turn by hand had {every} electrical turns, none a whole number: name them with "
        "--pole-pairs N"
    )  # fmt: skip
