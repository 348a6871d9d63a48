"""Position observers run on the host, from what the drive measured: live on chunks, or over a whole recording.

The kernels are those of the simulated drive, `sim.observers`. `HostObservers` runs those that the drive runs, too; fed
with the raw values that telemetry carries they give the same estimates, bit for bit, so a difference means that the
drive's firmware differs. `Estimators` runs any observers of the catalogue. Neither ever touches a link, and neither
runs ahead of its input: an edge is used once a sample at or after it has arrived.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError
from bench.replay.current_error import CurrentError
from bench.signal.chunks import breaks, part
from bench.signal.parameters import Change, course_of
from protocol.descriptor import Channel
from protocol.signals import Flag, RawType, Signal, Status
from protocol.streams import EdgeChunk, SampleChunk, StreamConfig
from protocol.text import did_you_mean
from sim.native import address, layout
from sim.observers import hall_speed, sample
from sim.observers.catalogue import BROKEN, CATALOGUE
from sim.observers.entry import CURRENT, VOLTAGE, Entry, chosen, missing

INPUTS = ("hall", "status", *VOLTAGE, *CURRENT, "i_q_ref", "i_q")
"""All channels that `Estimators` look at. Without status no resets are known, without i_q_ref and i_q the drive's
current error is taken as 0; what an observer needs of the others, its entry says."""
CHECKED = {channel: (entry.name, field) for entry in CATALOGUE.values() for channel, field in entry.channels.items()}
"""The channels that carry an observer's results: its name, and the field of its estimates."""
WORTH_THREADS = 8000  # samples from which on it pays to run observers side by side
PORTION = 1 << 13  # samples that they run over at a time: what stays in the cache
MEASURED, EDGE = layout(sample.Measured), layout(hall_speed.Edge)
T = TypeVar("T")
R = TypeVar("R")
F64 = NDArray[np.float64]
Flags = NDArray[np.bool_]
Records = NDArray[np.void]


def _drive_resets(chunk: SampleChunk) -> Flags:
    """Where the drive says that it initialised its observers, shape (n,)."""
    if "status" not in (chunk.raw.dtype.names or ()):
        return np.zeros(len(chunk), bool)
    flags: Flags = (chunk.raw["status"] & Status.OBSERVERS_RESET) != 0
    return flags


class HostObservers:
    """Runs the observers whose estimates a drive streams, over its chunks: edges first, then the samples they cover.

    `stream`: what is streamed; the estimates among it are compared. The observers start when the drive initialises
    its own (the `status` bit OBSERVERS_RESET); after a gap they wait for the next time, because what they would have
    remembered is lost. Raises BenchError for a parameter that one of them cannot do without.
    """

    def __init__(self, parameters: Mapping[str, float], stream: StreamConfig) -> None:
        self.checked = {c.name: CHECKED[c.name] for c in stream.channels if c.name in CHECKED}
        names = dict.fromkeys(observer for observer, _ in self.checked.values())
        self._kernels = _Kernels([CATALOGUE[name] for name in names], parameters, stream, (*VOLTAGE, *CURRENT))
        self._synchronised = False

    def edges(self, chunk: EdgeChunk) -> None:
        """Take edges; they wait for the samples that cover them."""
        if chunk.gaps:
            self._synchronised = False
        self._kernels.edges(chunk)

    def change(self, change: Change, exact: bool) -> None:
        """A parameter of the drive has changed.

        Where the drive has not said when, or samples after that have been taken, nothing is compared until the drive
        initialises its observers.
        """
        if self._kernels.newest_value(change.name) != change.value and not (self._kernels.change(change) and exact):
            self._synchronised = False

    def samples(self, chunk: SampleChunk) -> tuple[dict[str, F64], Flags]:
        """The estimates at the samples of `chunk` by channel, and where they are valid; arrays of shape (n,).

        The chunk must have what `compared_inputs` names at full rate.
        """
        reset = _drive_resets(chunk)
        before = -1 if self._synchronised else -3
        last_reset = np.maximum.accumulate(np.where(reset, np.arange(len(reset)), before))
        last_gap = np.full(len(reset), -2)
        for gap in chunk.gaps:
            last_gap[gap.position :] = gap.position
        valid: Flags = last_reset >= last_gap
        self._synchronised = bool(valid[-1])
        found = self._kernels.run(chunk, reset)
        return {name: found[observer][field] for name, (observer, field) in self.checked.items()}, valid

    def compare(self, chunk: SampleChunk) -> tuple[int, int]:
        """Number of samples compared with the drive's own estimates, and of those that differ in any raw bit."""
        estimates, valid = self.samples(chunk)
        differ = np.zeros(len(valid), dtype=bool)
        for name, values in estimates.items():
            differ |= raw_counts(chunk.config.channel(name), values) != chunk.raw[name]
        return int(valid.sum()), int((differ & valid).sum())


class _Kernels:
    """Observers behind one front end: their constants, their states, and the time that each of them took.

    Chunks go in: edges wait here for the samples that cover them.

    `parameters` of a `ParameterCourse` are followed: each sample is taken with those that the drive had.
    `fed`: the voltages and currents that they are given; a chunk must have them.
    `seconds` is the processor's time that each observer took for `steps` samples, `front_seconds` what the front end
    took, which is all that the average-speed approach needs.
    """

    def __init__(
        self, entries: Sequence[Entry], parameters: Mapping[str, float], stream: StreamConfig, fed: Sequence[str]
    ) -> None:
        _require("the Hall front end", missing(sample.Settings, parameters))
        for entry in entries:
            _require(entry.name, entry.missing(known(entry, parameters, fed)))
        self._fed, self._stream = fed, stream
        self._parameters, self._changes = dict(parameters), list(course_of(parameters).changes)
        self._taken = -1  # tick of the newest sample
        self._front = sample.FrontEnd(self._front_params())
        self._observers = {entry.name: entry.start(self._params(entry)) for entry in entries}
        self._current_error = CurrentError(parameters, stream.pwm_hz)
        self._edges: Records = np.empty(0, EDGE)
        self._measured: Records = np.empty(0, MEASURED)  # what is not fed stays 0
        self.seconds = dict.fromkeys(self._observers, 0.0)
        self.front_seconds = 0.0
        self.steps = 0

    def edges(self, chunk: EdgeChunk) -> bool:
        """Take edges. A clock that goes back is that of a drive that has started anew: older edges are of no use.

        Whether such older edges were dropped.
        """
        anew = bool(len(chunk) and len(self._edges) and chunk.tick[0] < self._edges["tick"][-1])
        new = np.empty(len(chunk), EDGE)
        new["tick"], new["code"] = chunk.tick, chunk.hall_new
        self._edges = new if anew else np.concatenate([self._edges, new])
        return anew

    def _front_params(self) -> sample.Params:
        return sample.make_params(self._stream.tick_hz, chosen(sample.Settings, self._parameters))

    def _params(self, entry: Entry) -> Any:
        return entry.make_params(self._stream.rate, known(entry, self._parameters, self._fed))

    def newest_value(self, name: str) -> float | None:
        """The value that a parameter has, or will have after all changes that are known; None where it has none."""
        later = [change.value for change in self._changes if change.name == name]
        return later[-1] if later else self._parameters.get(name)

    def change(self, change: Change) -> bool:
        """A parameter changes; whether that is in time: no sample after it has been taken."""
        self._changes = sorted([*self._changes, change], key=lambda change: change.tick)
        return change.tick >= self._taken

    def _follow(self, tick: int) -> None:
        """Use the parameters that the drive had at the sample of this tick."""
        if not (self._changes and self._changes[0].tick < tick):
            return
        while self._changes and self._changes[0].tick < tick:
            change = self._changes.pop(0)
            self._parameters[change.name] = change.value
        self._front.params = self._front_params()
        for observer in self._observers.values():
            observer.params = self._params(observer.entry)
        self._current_error.use(self._parameters)

    def run(self, chunk: SampleChunk, reset: Flags) -> dict[str, Records]:
        """The observers' estimates at the samples of `chunk` by name; `reset` (n,): where they are initialised."""
        found = {name: np.empty(len(chunk), observer.dtype) for name, observer in self._observers.items()}
        changed = np.searchsorted(chunk.tick, [change.tick for change in self._changes], side="right")
        bounds = sorted({0, *range(0, len(chunk), PORTION), *changed.tolist()})
        for first, last in pairwise([*(bound for bound in bounds if bound < len(chunk)), len(chunk)]):
            self._follow(int(chunk.tick[first]))
            rows = slice(first, last)
            self._portion(
                part(chunk, rows.start, rows.stop), reset[rows], {name: of[rows] for name, of in found.items()}
            )
        self._taken = int(chunk.tick[-1]) if len(chunk) else self._taken
        return found

    def _portion(self, chunk: SampleChunk, reset: Flags, found: Mapping[str, Records]) -> None:
        if len(self._measured) < len(chunk):
            self._measured = np.zeros(len(chunk), MEASURED)
        measured = self._measured[: len(chunk)]
        measured["tick"], measured["hall"] = chunk.tick, chunk.raw["hall"]
        for name in self._fed:
            measured[name] = chunk.physical(name)
        if VOLTAGE[0] in self._fed:
            measured["i_q_err"] = self._current_error.of(chunk, reset)
        used = int(np.searchsorted(self._edges["tick"], chunk.tick[-1], side="right"))
        due, self._edges = self._edges[:used], self._edges[used:]
        begun = time.thread_time()
        samples = self._front.run(measured, due, reset)
        self.front_seconds += time.thread_time() - begun

        def observe(name: str) -> None:
            begun = time.thread_time()
            self._observers[name].step_over(address(samples), address(reset), len(reset), address(found[name]))
            self.seconds[name] += time.thread_time() - begun

        # the first time they are compiled or loaded, which is this thread's to do
        side_by_side(observe, self._observers, len(reset) if self.steps else 0)
        self.steps += len(reset)


def side_by_side(action: Callable[[T], R], items: Iterable[T], n: int) -> list[R]:
    """What `action` gives of each item, by threads if it goes through enough samples, n, without the interpreter."""
    return list(_threads().map(action, items) if n >= WORTH_THREADS else map(action, items))


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count())


class Estimate(NamedTuple):
    """What an observer makes of n samples, (n,) each."""

    theta: F64  # electrical rad in [-pi, pi)
    omega: F64  # electrical rad/s


class Estimators:
    """Runs observers of the catalogue over a drive's chunks: edges first, then the samples that cover them.

    All of them share one front end. They are initialised anew with the first sample, where the drive initialises its
    own, and after every loss: with the first sample after lost samples, or at or after the first edge that follows
    lost edges. `restarts` counts these; `kernels` knows what the observers took. Without `follow` they go on where the
    drive initialises its own.

    Parameters that are a `ParameterCourse` are followed, and `change` tells of more, as they come.

    Raises BenchError for a name that the catalogue does not have, and for a parameter that an observer cannot do
    without.
    """

    def __init__(
        self, names: Sequence[str], parameters: Mapping[str, float], stream: StreamConfig, follow: bool = True
    ) -> None:
        self._follow = follow
        self.entries = tuple({entry.name: entry for entry in map(entry_of, names)}.values())
        for entry in self.entries:
            _require_fit(entry, stream, entry.needs.required)
        self.kernels = _Kernels(self.entries, parameters, stream, given(stream))
        self._next_index: int | None = None
        self._next_edge: int | None = None
        self._edges_lost = np.empty(0, np.int64)  # ticks of the edges that follow a loss
        self.restarts = {"start": 0, "drive": 0, "lost_samples": 0, "lost_edges": 0}

    def edges(self, chunk: EdgeChunk) -> None:
        """Take edges; they wait for the samples that cover them."""
        if len(chunk):
            if self.kernels.edges(chunk):
                self._edges_lost = self._edges_lost[:0]
            self._edges_lost = np.concatenate(
                [self._edges_lost, chunk.tick[breaks(chunk.index, expected=self._next_edge)]]
            )
            self._next_edge = int(chunk.index[-1]) + 1

    def samples(self, chunk: SampleChunk) -> dict[str, Estimate]:
        """Estimates at the samples of `chunk`, one or more, by observer; what `unfit` says must not hold for it."""
        found = self.records(chunk)
        return {name: Estimate(estimates["theta"], estimates["omega"]) for name, estimates in found.items()}

    def records(self, chunk: SampleChunk) -> dict[str, Records]:
        """The same with all that an observer says of itself: records of its own `Estimate`, (n,) each."""
        reset = _drive_resets(chunk) if self._follow else np.zeros(len(chunk), bool)
        self.restarts["drive"] += int(reset.sum())
        if self._next_index is None:
            self.restarts["start"] += 1
            reset[0] = True
        lost = breaks(chunk.index, chunk.config.index_step, self._next_index)
        self._next_index = int(chunk.index[-1]) + chunk.config.index_step
        known = int(np.searchsorted(self._edges_lost, chunk.tick[-1], side="right"))
        after = np.searchsorted(chunk.tick, self._edges_lost[:known])
        self._edges_lost = self._edges_lost[known:]
        self.restarts["lost_samples"] += len(lost)
        self.restarts["lost_edges"] += len(after)
        reset[lost] = reset[after] = True
        return self.kernels.run(chunk, reset)


def compared_inputs(channels: Collection[str], load_angle_comp: bool) -> tuple[str, ...]:
    """What must be streamed, with these channels, that their estimates can be compared.

    `load_angle_comp`: whether the drive compensates the load angle, with its own current error.
    """
    compensated = load_angle_comp or any(CHECKED.get(name, ("",))[0] == "load_angle" for name in channels)
    return INPUTS if compensated else tuple(name for name in INPUTS if name not in ("i_q_ref", "i_q"))


def all_for(
    parameters: Mapping[str, float], stream: StreamConfig
) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Names of all observers that a drive's parameters and its stream suffice for; the others in words, by what they
    lack: of parameters, of channels.
    """
    front, fed = missing(sample.Settings, parameters), given(stream)
    unfed = {name: why for name, entry in CATALOGUE.items() if (why := unfit(stream, entry.needs.required))}
    lacking = {
        name: dict.fromkeys((*front, *entry.missing(known(entry, parameters, fed))))
        for name, entry in CATALOGUE.items()
        if name not in unfed
    }
    return (
        tuple(name for name, needs in lacking.items() if not needs),
        tuple(f"{name}: it needs {', '.join(needs)}" for name, needs in lacking.items() if needs),
        tuple(
            f"{', '.join(name for name, of in unfed.items() if of == why)}: {why}"
            for why in dict.fromkeys(unfed.values())
        ),
    )


def given(stream: StreamConfig) -> tuple[str, ...]:
    """The voltages and currents that observers are given of a stream: those of every PWM period. A voltage without the
    currents tells nothing of the rotor.
    """
    there = {channel.name for channel in stream.channels}
    if stream.decimation != 1 or not there.issuperset(CURRENT):
        return ()
    return (*VOLTAGE, *CURRENT) if there.issuperset(VOLTAGE) else CURRENT


def known(entry: Entry, parameters: Mapping[str, float], fed: Sequence[str]) -> Mapping[str, float]:
    """The drive's parameters for an observer, with those that matter only to what it is not `fed`."""
    lacking, without = set(entry.needs.helpful).difference(fed), entry.needs.without
    if not lacking:
        return parameters
    unheard = {"R_s_hat": without["R_s_hat"]} if "R_s_hat" in without and not lacking.isdisjoint(VOLTAGE) else {}
    return {**without, **parameters, **unheard}


def done_without(names: Collection[str], stream: StreamConfig) -> tuple[str, ...]:
    """Which of these observers, by name, run on a stream without what would help them, in words."""
    lacking = {name: sorted({*CATALOGUE[name].needs.helpful}.difference(given(stream))) for name in names}
    why = "not streamed" if stream.decimation == 1 else "not at every PWM period"
    return tuple(
        f"{', '.join(name for name, of in lacking.items() if of == what)}: without {', '.join(what)}, {why}"
        for what in {tuple(what): what for what in lacking.values() if what}.values()
    )


def entry_of(name: str) -> Entry:
    """The observer of that name, or of that short name; - stands for _. BenchError, naming what there is, if none."""
    known = {name: entry for entry in CATALOGUE.values() for name in (entry.name, entry.short)}
    wanted = name.replace("-", "_")
    if wanted in known:
        return known[wanted]
    if wanted in BROKEN:
        raise BenchError(f"observer '{name}' cannot be used: {BROKEN[wanted]}")
    there = ", ".join(f"{entry.name} ({entry.short})" for entry in CATALOGUE.values())
    near = did_you_mean(wanted, known, form=" (did you mean {}?)")
    raise BenchError(f"no observer '{name}'{near}; available: {there}")


def unfit(config: StreamConfig, required: Sequence[str] = ()) -> str:
    """Why observers that must have these channels beside `hall` cannot run on a stream, in words; empty if they can."""
    names = {channel.name for channel in config.channels}
    if missing := [name for name in ("hall", *required) if name not in names]:
        return f"it has no channel {', '.join(missing)}"
    if config.decimation == 1 or not required:
        return ""
    return f"the stream is decimated by {config.decimation}; observers on voltages need every PWM period"


def raw_counts(channel: Channel | Signal, values: F64) -> NDArray[np.generic]:
    """Raw values of physical ones, as the simulated drive rounds them: half to even; angles wrap, others saturate."""
    dtype = np.dtype(channel.raw.dtype)
    if channel.raw == RawType.F32:
        return ((values - channel.offset) / channel.scale).astype(dtype)
    counts = (values - channel.offset if channel.offset else values) * (1.0 / channel.scale)
    np.rint(counts, out=counts)
    if not channel.flags & Flag.WRAPS:
        info = np.iinfo(dtype)
        np.minimum(np.maximum(counts, info.min, out=counts), info.max, out=counts)
    return counts.astype(np.int64).astype(dtype)


def _require_fit(entry: Entry, stream: StreamConfig, channels: Sequence[str]) -> None:
    if why := unfit(stream, channels):
        raise BenchError(f"{entry.name} cannot run on this stream: {why}")


def _require(what: str, names: Sequence[str]) -> None:
    if names:
        raise BenchError(f"{what} needs {', '.join(names)}, which the drive does not have")
