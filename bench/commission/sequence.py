"""The steps of a commissioning, in their order, and what each needs of those before it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from bench.commission.outcome import Outcome
from bench.commission.stand import Stand
from bench.commission.steps import ammeter, check, first_current, inductance, offsets, resistance, spun, turn
from bench.errors import BenchError
from bench.rig.envelope import Envelope
from protocol.text import did_you_mean


@dataclass(frozen=True)
class Step:
    """One step: what it is called, what it says before it begins, and what it does."""

    name: str
    aliases: tuple[str, ...]
    needs: tuple[str, ...]
    """Steps whose findings it goes by."""
    energises: bool
    announcement: Callable[[Envelope], str]
    """Of what was agreed to."""
    measure: Callable[[Stand], Outcome]
    turns: bool = False
    """Whether it turns the shaft."""
    spins: bool = False
    """Whether it does so as fast as was agreed to."""

    def perform(self, stand: Stand) -> Outcome:
        """Take it, and keep for the next ones what it has found. Raises Refused."""
        with stand.naming(self.name):
            stand.outcomes[self.name] = outcome = self.measure(stand)
        return outcome


_AMMETER = Step(ammeter.STEP, (), (resistance.STEP,), True, ammeter.announcement, ammeter.perform)
_ORDER = (
    Step(offsets.STEP, ("noise",), (), False, offsets.announcement, offsets.perform),
    Step(first_current.STEP, ("first",), (offsets.STEP,), True, first_current.announcement, first_current.perform),
    Step(resistance.STEP, ("r", "dead-time"), (first_current.STEP,), True, resistance.announcement, resistance.perform),
    _AMMETER,
    Step(inductance.STEP, ("l",), (resistance.STEP,), True, inductance.announcement, inductance.perform),
    Step(turn.STEP, ("dragged-turn",), (inductance.STEP,), True, turn.announcement, turn.perform, turns=True),
    Step(spun.STEP, ("coast",), (turn.STEP,), True, spun.announcement, spun.perform, turns=True, spins=True),
    Step(check.STEP, ("gains",), (inductance.STEP,), True, check.announcement, check.perform),
)
STEPS = tuple(step for step in _ORDER if step is not _AMMETER)
"""In their order; beside them there is that which holds a current for an ammeter."""


def chosen(names: Iterable[str] | None, with_ammeter: bool = False) -> tuple[Step, ...]:
    """The steps of these names, None: all, with all that they need, in their order. BenchError for an unknown name.

    `with_ammeter`: also that which holds a current for one, right after the resistance.
    """
    known = {name: step for step in STEPS for name in (step.name, *step.aliases)}
    wanted: set[str] = set()
    for name in [step.name for step in STEPS] if names is None else names:
        if name.lower() not in known:
            hint = did_you_mean(name, known, f"there are {', '.join(step.name for step in STEPS)}")
            raise BenchError(f"no step '{name}' of a commissioning: {hint}")
        _add(known[name.lower()], known, wanted)
    if with_ammeter:
        _add(_AMMETER, known, wanted)
    return tuple(step for step in _ORDER if step.name in wanted)


def _add(step: Step, known: dict[str, Step], wanted: set[str]) -> None:
    wanted.add(step.name)
    for name in step.needs:
        _add(known[name], known, wanted)
