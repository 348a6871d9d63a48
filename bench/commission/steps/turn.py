"""Step 4: the shaft is turned slowly, both ways, by a d current at an angle that is made.

Nothing that measures the shaft is believed yet: the current drags the rotor after the angle, a whole turn of the shaft
each way by the encoder, which the drive takes for that of one pole pair meanwhile. That tells pole pairs, the encoder's
direction and rough zero, and how the Hall sensors are wired and where they sit; and what it takes to turn the shaft.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from bench.commission import gains
from bench.commission.analysis import dragged, hall_order
from bench.commission.analysis.dragged import Dragged
from bench.commission.analysis.hall_order import HallOrder
from bench.commission.analysis.stretches import merged
from bench.commission.outcome import Evidence, Outcome, Panel
from bench.commission.quantity import Quantity
from bench.commission.refusal import Refused
from bench.commission.stand import Stand, Stretch, Turned
from bench.commission.steps.without_encoder import counted_by_hand, run_on_halls
from bench.commission.window import Floats, Window
from bench.findings.finding import Finding, degrees
from bench.rig.envelope import Envelope
from bench.signal.position import unwrapped
from bench.signal.units import RPM

STEP = "turn"
SHARE = 0.5
"""Of the agreed current, that drags the rotor."""
FASTEST_LOOP = 800.0
"""Hz of the current loop while the shaft turns, at most."""
SPEED = 3.0 * math.tau
"""rad/s, electrical, of the angle that drags it; with one pole pair the shaft is as fast."""
MARGIN = 0.95
"""Of the agreed speed, that a shaft with one pole pair may have."""
RAMP = 0.3
"""s in which the angle gets to its speed."""
SETTLE = 0.3
"""s after it, until the rotor follows evenly."""
START = 2.0 * RAMP + SETTLE
"""s of a way before it is looked at, at most."""
EDGES = 24.0
"""Hall edges of an electrical turn for which there is room: sensors that bounce make more than six."""
LOOK = 0.05
"""s from look to look at the shaft."""
WHOLE = math.tau + 0.1
"""rad of the shaft, each way."""
BLIND = 4.0 * math.tau
"""rad, electrical, each way without an encoder; and with one, after which a shaft that stands still is let go."""
STILL = 0.05
"""rad of the shaft, below which it stands still."""
ELSEWHERE = math.radians(15.0)
"""rad by which the Hall ring sits elsewhere than expected, from which it is told."""
FIRST = ("motor_phases", "heavy")
"""Findings that have to be put right before the shaft may be spun."""
SHOWN = 1500
"""Points of a curve."""


def perform(stand: Stand) -> Outcome:
    """Turn it, and tell the drive what pole pairs and encoder are."""
    stand.compensate(stand.L, min(FASTEST_LOOP, gains.bandwidth(stand.L, stand.limits)))
    n_p = 1 if stand.has_encoder or stand.pole_pairs is None else stand.pole_pairs
    stand.set(n_p=float(n_p), encoder_zero=0.0, encoder_reverse=0.0)
    current = SHARE * stand.i_max
    lines = int(stand.rig.drive.parameters.get("encoder_lines", 0))
    up, down, moved = _both_ways(stand, current, lines)
    if moved:  # a counter that its index has set right is believed from then on
        up, down, again = _both_ways(stand, current, lines)
        if again:
            raise Refused(
                STEP, f"the encoder's angle jumps by {degrees(again)} of the shaft where it has been before: its "
                "index pulse comes at more places than one, it loses counts, or its lines are not "
                f"{lines or 'as the drive has them'}"
            )  # fmt: skip
    outcome, turned = analyse(up, down, lines, current, stand.i_max)
    if moved:
        told = (
            f"the encoder's index came by and moved its angle by {degrees(moved)} of the shaft: after each power-on "
            "the angle, and encoder_zero with it, is true only once the shaft has turned past the index"
        )
        outcome = replace(outcome, remarks=(*outcome.remarks, told))
    found = turned.dragged
    if found is None:
        psi = dragged.rough_flux([up, down], stand.L, current)
        outcome, stand.turned = _blind(stand, outcome, turned, psi)
        return outcome
    if found.direction < 0 and not stand.rig.drive.node.has_parameter("encoder_reverse"):
        raise Refused(STEP, "the encoder counts backwards: exchange its tracks A and B")
    stand.set(**outcome.settings, encoder_zero=found.zero.value)
    if stand.pole_pairs not in (None, found.n_p):
        words = (
            f"the encoder shows {found.n_p} pole pairs, and {stand.pole_pairs} were told: the number is wrong, or the "
            f"encoder's lines are not {lines or 'as the drive has them'}"
        )
        outcome = replace(outcome, refused=(*outcome.refused, Refused(STEP, words)))
        turned = replace(turned, first=turned.first or words)
    stand.turned = turned
    return outcome


def _blind(stand: Stand, outcome: Outcome, turned: Turned, psi: float) -> tuple[Outcome, Turned]:
    """Without an encoder: the drive on its Hall sensors as they are wired, and the pole pairs as a person knows them.

    `psi`: V s, rough.
    """
    quantities, refused, settings = [*outcome.quantities], [*outcome.refused], {**outcome.settings}
    remarks, n_p = [*outcome.remarks], stand.pole_pairs
    if turned.hall is not None:
        try:
            settings |= (wiring := run_on_halls(stand, turned.hall, psi))
            if any(stand.rig.drive.parameters.get(name, 0.0) != 0.0 for name in wiring):
                told = ", ".join(f"{name} = {value:g}" for name, value in wiring.items())
                remarks.append(f"edges are of the Hall sensors as they are wired now, with {told}")
        except Refused as lacking:
            refused.append(lacking)
            turned = replace(turned, hall=None)
    if n_p is None and turned.hall is not None and stand.by_hand:
        try:
            quantities.append(ratio := counted_by_hand(stand))
            n_p = round(ratio.value)
        except Refused as uncounted:
            refused.append(uncounted)
    elif n_p is None:
        refused.append(Refused(STEP, "pole pairs are not claimed: without an encoder name them with --pole-pairs N"))
    if n_p is not None:
        settings["n_p"] = float(n_p)
        stand.set(n_p=float(n_p))
    more = replace(outcome, quantities=tuple(quantities), refused=tuple(refused), remarks=tuple(remarks))
    return replace(more, settings=settings), replace(turned, n_p=n_p)


def _speed(stand: Stand) -> float:
    """rad/s, electrical, within the agreed speed whatever the pole pairs are."""
    return min(SPEED, MARGIN * stand.rpm * RPM)


def _both_ways(stand: Stand, current: float, lines: int) -> tuple[Window, Window, float]:
    """The two ways with a `current`, A, and by how much the encoder has jumped meanwhile, rad of the shaft."""
    with stand.running():
        stand.ramp(0.05 * current, current, 0.6, 30)
        stand.wait(0.4)
        turn = math.tau / _speed(stand)
        stand.keep(2.0 * (dragged.MOST_PAIRS * turn + START), LOOK, EDGES / turn)
        ways = [_way(stand, way * _speed(stand)) for way in (1.0, -1.0)]
        stand.current(0.0)
        stand.wait(0.02)
    up, down = (way.window for way in ways)
    if up is None or down is None:
        raise Refused(STEP, "the drive's memory holds too little of a turn")
    return up, down, dragged.jump([up, down], lines) if up.theta is not None else 0.0


def _way(stand: Stand, omega: float) -> Stretch:
    """One way, at a speed that does not change, by a whole turn of the shaft if it follows."""
    stand.drag(omega, abs(omega) / RAMP)
    stand.wait((2.0 if omega < 0.0 else 1.0) * RAMP + SETTLE)
    gone, turned, last = 0.0, 0.0, math.nan
    with stand.stretch("forced") as taken:
        while gone < dragged.MOST_PAIRS * math.tau:
            look = stand.look(LOOK)
            gone += abs(omega) * LOOK
            if look.theta is None:
                if gone > BLIND:
                    break
                continue
            shaft = unwrapped(look.theta if math.isnan(last) else np.concatenate([[last], look.theta]))
            turned, last = turned + float(shaft[-1] - shaft[0]), float(look.theta[-1])
            if abs(turned) > WHOLE or (gone > BLIND and abs(turned) < STILL):
                break
    return taken


def analyse(up: Window, down: Window, lines: int, current: float, i_max: float) -> tuple[Outcome, Turned]:
    """What windows dragged forward and in reverse by a `current`, A, tell; with n_p = 1 and the zero at 0 meanwhile.

    `lines` of the encoder by the drive, 0 for not known. Refused where an encoder does not follow the angle.
    """
    found = dragged.dragged([up], [down], lines=lines) if up.theta is not None else None
    direction = None if found is None else found.direction
    quantities: list[Quantity] = []
    remarks: list[str] = []
    refused: list[Refused] = []
    settings: dict[str, float] = {}
    findings: list[Finding] = []
    order: HallOrder | None = None
    if found is not None:
        quantities += [found.ratio, found.zero, found.lag]
        settings |= {"n_p": float(found.n_p), "encoder_reverse": float(direction == -1)}
        if heavy := hall_order.heavy(found.share, current, i_max):
            findings.append(heavy)
    share = 0.0 if found is None else found.share
    try:
        order = hall_order.hall_order([up], [down])
        if found is None:
            share = abs(math.sin(order.lag))
            if heavy := hall_order.heavy(share, current, i_max, hall_order.HEAVY_BY_EDGES):
                findings.append(heavy)
        findings += hall_order.verdicts(order, direction)
    except Refused as nothing:
        refused.append(nothing)
    told = [each for each in findings if each.code != "encoder_reversed"]
    remarks += [f"{each.line}; {each.advice}" for each in findings if each.code == "encoder_reversed"]
    refused += [Refused(STEP if each.code in FIRST else hall_order.STEP, _sentence(each)) for each in told]
    # without an encoder the drive is to run on these sensors: it is told how they are wired
    fine = ("heavy",) if found is not None else ("heavy", "wiring")
    wrong = [each for each in told if each.code not in fine]
    usable = order if order is not None and order.edges is not None and not wrong else None
    if order is not None and not wrong:
        if order.edges is not None:
            quantities += [order.edges.ring, *order.edges.up, *order.edges.down]
        ring = hall_order.orientation(order)
        if ring is not None and order.wired is not None and abs(order.wired.ring) > ELSEWHERE:
            remarks.append(ring.cause)
    first = next((each.cause for each in told if each.code in FIRST), "")
    figures = {"in_order": math.nan if order is None else order.in_order, "current": current}
    evidence = Evidence("The shaft dragged by a d current, both ways", _panels(up, down, found), figures)
    outcome = Outcome(tuple(quantities), evidence, tuple(remarks), tuple(refused), settings)
    return outcome, Turned(found, usable, first, None if found is None else found.n_p, share)


def _sentence(finding: Finding) -> str:
    return "; ".join(filter(None, (finding.line, finding.advice)))


def _panels(up: Window, down: Window, found: Dragged | None) -> tuple[Panel, ...]:
    ways = {"forward": up, "in reverse": down}
    codes = {name: _codes(window) for name, window in ways.items()}
    panels = [Panel("angle that is made", "electrical turns", "Hall code", "", codes)]
    if found is not None:
        behind = {name: _behind(window, found) for name, window in ways.items()}
        panels.insert(0, Panel("shaft", "turns", "encoder ahead", "deg", behind))
    return tuple(panels)


def _codes(window: Window) -> tuple[Floats, Floats]:
    at = np.interp(window.edges.index, window.index, unwrapped(window.control)) / math.tau
    return np.asarray(at), window.edges.new.astype(float)


def _behind(window: Window, found: Dragged) -> tuple[Floats, Floats]:
    (whole,) = merged([window], by_command=False)
    every = max(1, len(whole) // SHOWN)
    shaft = unwrapped(np.asarray(whole.theta))[::every]
    ahead = found.direction * found.n_p * shaft + found.zero.value - unwrapped(whole.control)[::every]
    turns = round(float(np.mean(ahead)) / math.tau)
    return shaft / math.tau, np.degrees(ahead - math.tau * turns)


def announcement(agreed: Envelope) -> str:
    """What will be done, within what was agreed to."""
    rpm = min(SPEED / RPM, MARGIN * agreed.rpm)
    return (
        f"{SHARE * agreed.current:.3g} A turn the shaft slowly, a whole turn each way, at {rpm:.0f} r/min at most; "
        "it has to be free"
    )
