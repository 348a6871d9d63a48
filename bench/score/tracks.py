"""A recording as the scoreboard sees it: every estimate against the reference, by what the shaft does.

The estimates are the drive's own channels, those that a replay has added, and those of observers that are run here. A
recording is gone through twice, piece by piece: `bench.score.course` first, then the estimates. Nothing keeps its
samples.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError
from bench.findings.late import blame
from bench.record.info import HOST_SUFFIX
from bench.record.reader import Run, ahead, captures
from bench.record.recording import Source, readable
from bench.record.times import ticks_between
from bench.replay.estimators import INPUTS, Estimate, Estimators, all_for, done_without, side_by_side
from bench.replay.replay import ENDS_EARLY, checked_settings, not_replayable
from bench.score.course import Course, Stretch, survey
from bench.score.phases import CONTEXT, phases_with, speed_of
from bench.score.reference import AUTO, EDGES, ENCODER, NOT_SEEN, Pieces, Reference, reference_of
from bench.score.tally import Block, Envelope, OverTime, Tally
from bench.signal.delays import delays_of
from bench.signal.position import Moments
from bench.signal.trace import STATOR, Trace
from bench.signal.units import pole_pairs
from bench.signal.waveforms import hall_offset
from bench.signal.windows import Window, windows
from protocol.signals import Flag, Unit
from protocol.streams import SampleChunk, StreamConfig
from sim.observers.catalogue import CATALOGUE

F64 = NDArray[np.float64]
POINTS = 6000  # of a plot over time, about
LEAST = 0.1  # s, shorter stretches between two losses are left out
FASTER = 1.5
"""Times the fastest speed of the shaft that observers are told to expect, where a recording does not tell."""
DRIVE, REPLAYED, HOST = "drive", "replayed", "host"


@dataclass(frozen=True)
class Track:
    """One recording. `kinds`: who made each estimate."""

    path: str
    rate: float
    """Samples a second."""
    pole_pairs: int
    reference: Reference
    sd: Moments
    """Of the reference's standard deviation over what is scored, electrical degrees; empty where none is stated."""
    unknown: int
    """Samples at which the reference tells no angle."""
    stretches: tuple[Stretch, ...]
    """Those that are scored: without a gap."""
    kinds: dict[str, str]
    tallies: dict[str, Tally]
    step_ns: dict[str, float]
    """What a step of each observer run here took on this machine, beside the front end's."""
    front_ns: float | None
    dropped: int
    """Samples in stretches too short to be of use."""
    lost: int
    every: int
    """Samples to a point of a plot over time; a stretch begins with a new point."""
    actual: Envelope
    """Speed by the reference over time, r/min."""
    over_time: dict[str, OverTime]
    started: str = ""
    """Date and time of the recording, as it tells them."""
    recorded_by: str = ""
    """Version of the host that recorded it; empty if it does not tell."""
    restarts: dict[str, int] = field(default_factory=dict)
    identity: Mapping[str, Any] = field(default_factory=dict)
    """What the recording says of the drive and the bench."""
    notes: tuple[str, ...] = ()

    @property
    def samples(self) -> int:
        """How many are scored, those at rest included."""
        return sum(stretch.n for stretch in self.stretches)

    @property
    def starts(self) -> int:
        """How often the shaft started."""
        return sum(len(stretch.turns.starts) for stretch in self.stretches)

    @property
    def reversals(self) -> int:
        """How often it turned round."""
        return sum(len(stretch.turns.reversals) for stretch in self.stretches)


@dataclass(frozen=True)
class Asked:
    """How recordings are to be scored. `names`: observers to run, None: all that parameters and channels suffice for;
    `begin`, `end`: device time in s.
    """

    names: Sequence[str] | None = None
    begin: float | None = None
    end: float | None = None
    reference: str = AUTO
    settings: Mapping[str, float] = field(default_factory=dict)
    """Drive parameters for the observers, by name."""


def load(source: Source, asked: Asked) -> Track:
    """Take a recording or a capture and run observers on it.

    Raises BenchError where it has no reference, no samples, or a clock that goes back.
    """
    run = readable(source)
    parameters = run.parameters
    parameters = parameters.fixed(checked_settings(asked.settings, asked.names or tuple(CATALOGUE), parameters))
    (config, _), recorded = run.drive_streams, _recorded(run.drive_streams[0])
    pieces: Pieces = partial(captures, run, *ticks_between(run, asked.begin, asked.end))
    channels = {name: angle for name, (_, angle, _) in recorded.items()}
    reference, pieces = reference_of(asked.reference, run, pieces, parameters, channels)
    n_p = pole_pairs(parameters)
    status = [channel.name for channel in config.channels if channel.name == "status"]
    speeds = _speeds(config)
    course = survey(pieces(channels={reference.channel, *speeds, *status}), reference.channel, speeds, n_p or 1)
    fastest = reference.fastest or (n_p or 1) * parameters.get("omega_m_max", 0.0)
    _require_unambiguous(course, str(run.path), config.rate, fastest)
    assumed = {"n_p": 1.0, "omega_m_max": FASTER * max(course.top_speed, reference.fastest) / (n_p or 1)}
    assumed = {name: value for name, value in assumed.items() if name not in parameters}
    found = _track(run, parameters.fixed(assumed), reference, pieces, course, asked.names)
    notes = list(found.notes)
    if "omega_m_max" in assumed and HOST in found.kinds.values():
        notes.append(f"omega_m_max is not told: observers expect {FASTER:g} times the fastest that the shaft turns")
    if n_p is None:
        notes.append("the number of pole pairs is unknown: r/min are electrical")
    return replace(found, notes=tuple(notes))


def _chosen(
    run: Run, parameters: Mapping[str, float], reference: Reference, names: Sequence[str] | None
) -> tuple[dict[str, str], Estimators | None, list[str]]:
    """The estimates that are scored and who makes each, the observers that are run, and notes. BenchError for none."""
    (config, edges), notes = run.drive_streams, list[str]()
    kinds = {name: kind for name, (kind, angle, _) in _recorded(config).items() if angle != reference.channel}
    lacking: tuple[str, ...] = ()
    estimators = None
    if why := not_replayable(config, edges):
        notes.append(f"no observer can run on it: {why}")
    else:
        if names is None:
            names, lacking, unfed = all_for(parameters, config)
            notes += [f"not run: {words}" for words in (*lacking, *unfed)]
        if names := [name for name in names if name != reference.kind]:
            estimators = Estimators(names, parameters, config)
            kinds |= dict.fromkeys((entry.name for entry in estimators.entries), HOST)
            notes += done_without(names, config)
    if not kinds:
        by_hand = "; give them with --set NAME=VALUE" if lacking else ""
        raise BenchError(
            f"{run.path} cannot be scored: {'; '.join(notes) or 'it has no estimate of the angle'}{by_hand}"
        )
    return kinds, estimators, notes


def _track(
    run: Run,
    parameters: Mapping[str, float],
    reference: Reference,
    pieces: Pieces,
    course: Course,
    names: Sequence[str] | None,
) -> Track:
    config, _ = run.drive_streams
    n_p, recorded = pole_pairs(parameters), _recorded(config)
    kinds, estimators, notes = _chosen(run, parameters, reference, names)
    if course.ran is False:
        notes.append("the drive was never RUNNING: all samples count")
    there = [channel.name for channel in config.channels]
    estimates = {name for _, angle, speed in recorded.values() for name in (angle, speed) if name}
    told = {name for name in (reference.channel, reference.sd_channel) if name}
    wanted = {*told, *estimates, *(name for name in (*INPUTS, *STATOR) if name in there)}
    scored = _Scored(course, kinds, reference, config.rate, parameters)
    trace = Trace()
    for window in ahead(windows(pieces(channels=wanted), CONTEXT)):
        if reference.kind == ENCODER:
            trace.add(window)
        found = _estimates(window.samples, recorded)
        if estimators is not None:
            estimators.edges(window.capture.edges)
            found |= estimators.samples(window.samples)
        scored.add(window, {name: found[name] for name in kinds})
    if reference.kind == ENCODER and (words := blame(delays_of(trace))[1]):
        notes.append(f"angles differ in time: {words}")
    if reference.kind == EDGES:
        notes = [*_by_edges(reference, course, scored.sd, (n_p or 1) * parameters.get("omega_m_max", math.inf)), *notes]
    kernels = None if estimators is None else estimators.kernels
    return Track(
        path=str(run.path),
        rate=config.rate,
        pole_pairs=n_p or 1,
        reference=reference,
        sd=scored.sd,
        unknown=course.unknown,
        stretches=tuple(stretch for stretch in course.stretches if scored.takes(stretch)),
        kinds=kinds,
        tallies=scored.tallies,
        step_ns={} if kernels is None else {name: 1e9 * s / kernels.steps for name, s in kernels.seconds.items()},
        front_ns=None if kernels is None else 1e9 * kernels.front_seconds / kernels.steps,
        dropped=sum(stretch.n for stretch in course.stretches if not scored.takes(stretch)),
        lost=course.lost,
        every=scored.every,
        actual=scored.actual,
        over_time=scored.over_time,
        started=run.info.started,
        recorded_by=str(run.info.identity.get("hallbench", "")),
        restarts={} if estimators is None else estimators.restarts,
        identity=run.info.identity,
        notes=(*([] if run.ended else [ENDS_EARLY]), *run.damage, *notes),
    )


def _by_edges(reference: Reference, course: Course, sd: Moments, allowed: float) -> list[str]:
    """What to know of a reference by edges; `allowed`: electrical rad/s that observers are told not to expect more."""
    beyond = f"omega_m_max is {allowed:.0f} electrical rad/s, and the edges show {reference.fastest:.0f}: --set more"
    within = f"; it holds within {sd.rms:.2f} deg rms, {sd.peak:.2f} at most (standard deviation)" if sd.n else ""
    share = course.unknown / max(course.samples, 1)
    return [
        f"reference: {reference.words}{within}",
        f"not scored: {course.unknown} of {course.samples} samples ({share:.0%}): the edges do not come steadily there",
        NOT_SEEN,
        *([beyond] if reference.fastest > allowed else []),
    ]


class _Scored:
    """The estimates of a recording against its reference, window by window."""

    def __init__(
        self, course: Course, kinds: Iterable[str], reference: Reference, rate: float, parameters: Mapping[str, float]
    ) -> None:
        self._course, self._reference, self._rate = course, reference, rate
        self._pole_pairs, self._hall_offset = pole_pairs(parameters) or 1, hall_offset(parameters)
        self._seen = 0  # samples
        self._number = -1  # of the stretch
        self.every = max(1, sum(stretch.n for stretch in course.stretches if self.takes(stretch)) // POINTS)
        points = [-(-stretch.n // self.every) if self.takes(stretch) else 0 for stretch in course.stretches]
        self._first_points = np.cumsum([0, *points])
        self.tallies = {name: Tally() for name in kinds}
        self.over_time = {name: OverTime(sum(points)) for name in kinds}
        self.actual = Envelope(sum(points))
        self.sd = Moments()

    def takes(self, stretch: Stretch) -> bool:
        """Whether it is long enough."""
        return stretch.n >= LEAST * self._rate

    def add(self, window: Window, estimates: Mapping[str, Estimate]) -> None:
        """Add a window, with the estimates of its own samples."""
        theta = window.capture.samples.physical(self._reference.channel)
        usable = self._course.usable(window.capture.samples)
        begin = window.own.start
        for rows, own in window.stretches(np.isfinite(theta)):
            self._number += own.start == rows.start
            stretch = self._course.stretches[self._number]
            if self.takes(stretch):
                block = self._block(stretch, theta[rows], usable[rows], rows, own, self._seen + own.start - begin)
                self.actual.add(block.points, block.omega[block.own] * block.rpm_by)
                if spread := self._reference.sd_channel:
                    self.sd.add(np.degrees(window.capture.samples.physical(spread)[own]))
                at = slice(own.start - begin, own.stop - begin)
                self._add(block, {name: Estimate(*(values[at] for values in its)) for name, its in estimates.items()})
        self._seen += window.own.stop - begin

    def _add(self, block: Block, estimates: Mapping[str, Estimate]) -> None:
        def add(name: str) -> None:
            self.tallies[name].add(block, estimates[name], self.over_time[name])

        block.keys  # noqa: B018 - which all share
        side_by_side(add, estimates, len(block.points))

    def _block(
        self, stretch: Stretch, theta: F64, usable: NDArray[np.bool_], rows: slice, own: slice, first: int
    ) -> Block:
        """`first`: number of the first of its `own` rows, counted from the recording's first sample."""
        since = first - stretch.first  # of its own rows, in the stretch
        omega = speed_of(theta, self._rate)
        turns = stretch.turns.since(since - (own.start - rows.start))
        number = since + np.arange(own.stop - own.start)
        return Block(
            theta,
            omega,
            phases_with(turns, omega, usable, self._rate, self._pole_pairs),
            slice(own.start - rows.start, own.stop - rows.start),
            self._rate,
            self._pole_pairs,
            self._hall_offset,
            stretch.t + since / self._rate,
            self._first_points[self._number] + number // self.every,
        )


def _require_unambiguous(course: Course, path: str, rate: float, allowed: float) -> None:
    """BenchError where the angle may turn half a turn from sample to sample.

    By the largest speed that the recording tells: the reference's, or the largest estimate; without either by that
    which the drive allows, electrical rad/s.
    """
    fastest = max(course.fastest.values(), default=allowed)
    if fastest >= math.pi * rate:
        raise BenchError(
            f"{path} cannot be scored: at {rate:g} samples/s, an electrical speed of {fastest:.0f} rad/s is half "
            f"a revolution or more per sample, which is ambiguous: record at --rate {fastest / 2:.0f} or more"
        )


def _speeds(config: StreamConfig) -> list[str]:
    """The channels that tell the largest speed: the reference's, else the estimates'."""
    channels = [c for c in config.channels if c.unit == Unit.RAD_PER_S]
    flagged = ([c.name for c in channels if c.flags & flag] for flag in (Flag.REFERENCE, Flag.ESTIMATE))
    return next((names for names in flagged if names), [])


def _recorded(config: StreamConfig) -> dict[str, tuple[str, str, str]]:
    """The estimates that are in a stream: who made it, channels of its angle and its speed, or "" for none.

    Those of the drive are named drive_<short>, a replay's replayed_<short>.
    """
    speeds = {c.name for c in config.channels if c.flags & Flag.ESTIMATE and c.unit == Unit.RAD_PER_S}
    found: dict[str, tuple[str, str, str]] = {}
    for channel in config.channels:
        if channel.flags & Flag.ESTIMATE and channel.unit == Unit.RAD:
            short = channel.name.removeprefix("theta_")
            kind = REPLAYED if short.endswith(HOST_SUFFIX) else DRIVE
            omega = f"omega_{short}"
            name = f"{kind}_{short.removesuffix(HOST_SUFFIX)}"
            found[name] = kind, channel.name, omega if omega in speeds else ""
    return found


def _estimates(samples: SampleChunk, recorded: Mapping[str, tuple[str, str, str]]) -> dict[str, Estimate]:
    unknown = np.full(len(samples), np.nan)
    return {
        name: Estimate(samples.physical(angle), samples.physical(speed) if speed else unknown)
        for name, (_, angle, speed) in recorded.items()
    }
