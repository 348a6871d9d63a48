"""One test while it runs: what it has measured so far, and the verdict at its end.

Nothing here knows pytest or a link.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from bench.accept.results import Figure, Measurement, Verdict, worst
from bench.errors import BenchError
from bench.files import file_name
from bench.signal.capture import Capture
from bench.signal.limits import YES_NO, Limits

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture


NOT_AS_SPECIFIED = "not as specified"
"""Why a value that is within its limits did not pass: it is out of the band of the spec."""


class NotPassed(Exception):
    """Not all that the test measured is as it should be. `verdict` is the worst of it."""

    def __init__(self, verdict: Verdict, text: str) -> None:
        super().__init__(text)
        self.verdict = verdict


@dataclass
class Running:
    """A test of this name with these limits. `figures` is where pictures go, None when nobody wants any."""

    name: str
    limits: Sequence[Limits]
    figures: Path | None = None
    specified: Mapping[str, Limits] = field(default_factory=dict)
    """Bands of `--spec`, by the names of limits."""
    measurements: list[Measurement] = field(default_factory=list)
    pictures: list[Figure] = field(default_factory=list)
    recording: Path | None = None
    """The recording of this run, once the test has come to the rig; None before that and when no report is wanted."""
    mark: Callable[[str, tuple[float, float], Verdict], None] = lambda name, span, verdict: None
    """Called with name, stretch and verdict of each measurement that did not pass, as it is made."""
    _to_draw: dict[str, tuple[str, Callable[[], Picture]]] = field(default_factory=dict)

    def measure(self, name: str, value: float, *captures: Capture) -> bool:
        """Compare `value`, in the unit of the declared limit `name`, with that limit; True if it is within.

        `captures` are what it was made from: if any of them has a flaw, the measurement is INVALID whatever the value.
        It never raises for a value that is out of limits: the test goes on, and fails at its end. BenchError for a name
        that was not declared, or measured before.
        """
        declared = next((limits for limits in self.limits if limits.name == name), None)
        if declared is None:
            names = ", ".join(limits.name for limits in self.limits)
            raise BenchError(f"{self.name} measures '{name}' but declares only: {names or 'nothing'}")
        if declared.of:
            raise BenchError(f"{self.name} measures '{name}', but nobody has told the drive's {declared.of}")
        full = f"{self.name}.{name}"
        if any(m.name == full for m in self.measurements):
            raise BenchError(f"{self.name} measures '{name}' twice")
        value = float(value)
        if declared.unit == YES_NO and value not in (0.0, 1.0) and not math.isnan(value):
            raise BenchError(f"{self.name} answers '{name}' with {value:.4g}: yes is 1 or True, no is 0 or False")
        band = self.specified.get(name)
        flaws = list(dict.fromkeys(flaw for capture in captures for flaw in capture.flaws()))
        if flaws:
            verdict, why = Verdict.INVALID, "; ".join(flaws)
        elif not declared.allow(value):
            verdict, why = Verdict.FAIL, "is not a number" if math.isnan(value) else ""
        elif band is not None and not band.allow(value):
            verdict, why = Verdict.FAIL, NOT_AS_SPECIFIED
        else:
            verdict, why = Verdict.PASS, ""
        spans = [capture.span for capture in captures]
        span = (min(a for a, _ in spans), max(b for _, b in spans)) if spans else None
        measurement = Measurement(full, declared, verdict, value, why, span, band)
        self.measurements.append(measurement)
        if span is not None and verdict is not Verdict.PASS:
            self.mark(full, span, verdict)
        return verdict is Verdict.PASS

    def figure(self, name: str, caption: str, draw: Callable[[], Picture]) -> None:
        """Have a picture drawn by `draw` once the bench is at rest; it is not called when no report is wanted.

        The test has a directory of its own for them. BenchError for a name that it has used before.
        """
        file = f"{file_name(name)}.png"
        if file in self._to_draw:
            raise BenchError(f"{self.name} draws '{name}' twice: rename one of them")
        self._to_draw[file] = (caption, draw)

    def draw(self) -> None:
        """Draw what was asked for: it takes longer than a watchdog, so nothing may turn any more."""
        to_draw, self._to_draw = self._to_draw, {}
        if self.figures is None:
            return
        from bench.accept.report_files import claim
        from bench.report.style import save

        folder = self.figures / file_name(self.name)
        for file, (caption, draw) in to_draw.items():
            name = f"{self.figures.name}/{folder.name}/{file}"
            folder.mkdir(parents=True, exist_ok=True)
            claim(self.figures.parent, name)
            save(draw(), folder / file)
            self.pictures.append(Figure(name, caption))

    def end(self) -> None:
        """Raise NotPassed, with a line for each thing, unless all that was declared was measured and passed."""
        self.give_up(Verdict.ERROR, "declared, but never measured")
        bad = [m for m in self.measurements if m.verdict is not Verdict.PASS]
        if bad:
            head = f"{len(bad)} of {len(self.measurements)} measurements did not pass"
            raise NotPassed(
                worst(m.verdict for m in bad), "\n".join([head, *(f"{m.name} = {value_text(m)}" for m in bad)])
            )

    def give_up(self, verdict: Verdict, why: str) -> None:
        """What was declared and not measured gets this verdict."""
        measured = {m.name for m in self.measurements}
        for declared in self.limits:
            if (full := f"{self.name}.{declared.name}") not in measured:
                band = self.specified.get(declared.name)
                self.measurements.append(Measurement(full, declared, verdict, why=why, specified=band))


def value_text(measurement: Measurement) -> str:
    """Value, limits, verdict and reason in one line."""
    value = "not measured" if measurement.value is None else measurement.limits.told(measurement.value)
    why = f" ({measurement.why})" if measurement.why else ""
    band = f"; specified {measurement.specified}" if measurement.specified else ""
    return f"{value} [{measurement.limits}{band}] {measurement.verdict}{why}"


def require_apart(names: Collection[str]) -> None:
    """BenchError if two tests have the same name, or names that make the same file name."""
    for name, often in Counter(names).items():
        if often > 1:
            raise BenchError(f"{often} tests are called '{name}', and limits go by name: rename all but one")
    files: dict[str, str] = {}
    for name in names:
        if (other := files.setdefault(os.path.normcase(file_name(name)), name)) != name:
            raise BenchError(f"'{other}' and '{name}' would write to the same files: rename one of them")
