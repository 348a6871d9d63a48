"""What estimates of a recording are compared with: the encoder, the recording's own Hall edges, or one of them.

Whichever it is, it is a channel of the pieces of the recording: that of the encoder, or one that is added to them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from bench.errors import BenchError
from bench.record.reader import Run
from bench.replay.estimators import INPUTS, Estimators, entry_of
from bench.replay.replay import not_replayable
from bench.signal.capture import Capture
from bench.signal.channels import reference_angle
from bench.signal.chunks import with_columns
from bench.signal.edge_angle import ANGLE, CHANNELS, SD, ByEdges, by_edges
from bench.signal.units import pole_pairs
from protocol.streams import StreamConfig

AUTO, ENCODER, EDGES = "auto", "encoder", "edges"
ACTUAL = {ENCODER: "encoder", EDGES: "angle by its own edges"}
"""What an estimate is taken from, by kind; of an observer its name."""
NOT_SEEN = (
    "reference by edges: bias is against the mean place of the edges; what they share (angle of the ring, a delay) and "
    "what repeats with each turn is not seen"
)
Pieces = Callable[..., Iterable[Capture]]
"""Gives captures that follow each other, with the `channels` that are asked for, as often as it is called."""


@dataclass(frozen=True)
class Reference:
    """The angle that the estimates of a recording are compared with."""

    kind: str
    """`ENCODER`, `EDGES`, or the name of an observer or of a recorded estimate."""
    channel: str
    sd_channel: str = ""
    """Channel of its standard deviation, rad; empty where none is stated."""
    fastest: float = 0.0
    """Electrical rad/s, about the highest speed that it shows; 0: unknown."""
    words: str = ""
    """How it was made, for people."""
    stated: Mapping[str, Any] | None = None
    """The same as plain data."""

    @property
    def is_estimate(self) -> bool:
        """Whether differences from it are no errors."""
        return self.kind not in ACTUAL

    @property
    def noun(self) -> str:
        """What the figures are of."""
        return "difference" if self.is_estimate else "error"


def reference_of(
    asked: str, run: Run, pieces: Pieces, parameters: Mapping[str, float], recorded: Mapping[str, str]
) -> tuple[Reference, Pieces]:
    """The reference that is `asked` for by kind, or the best that there is for `AUTO`; the pieces, with its channels.

    `recorded`: estimates that the recording has, and the channels of their angles. BenchError where it cannot be had.
    """
    (config, edges), path = run.drive_streams, run.path
    encoder = reference_angle(config.channels)
    if asked == ENCODER or (asked == AUTO and encoder):
        if not encoder:
            raise BenchError(f"{path} cannot be scored against an encoder: it has none; use --reference edges")
        return Reference(ENCODER, encoder), pieces
    if asked in (AUTO, EDGES):
        if why := not_replayable(config, edges):
            lacks = "no reference angle: it needs an encoder, or Hall codes and edges"
            raise BenchError(f"{path} cannot be scored: {lacks}; {why}")
        told = by_edges(lambda: pieces(channels={"hall"}), parameters, str(path))
        words = _words(told, pole_pairs(parameters) is not None)
        found = Reference(EDGES, ANGLE, SD, told.fit.fastest, words, _stated(told))
        return found, _with_edges(pieces, told)
    if (name := asked.replace("-", "_")) in recorded:
        return Reference(name, recorded[name]), pieces
    try:
        name = entry_of(asked).name
    except BenchError as error:
        raise BenchError(
            f"no reference '{asked}': it is encoder, edges, a recorded estimate or an observer; {error}"
        ) from None
    if why := not_replayable(config, edges, [name]):
        raise BenchError(f"{path} cannot be scored against {name}: {why}")
    return Reference(name, ANGLE), _with_observer(pieces, name, parameters, config)


def _with_edges(pieces: Pieces, told: ByEdges) -> Pieces:
    return lambda channels: told.added(pieces(channels=(set(channels) | {"hall"}) - {ANGLE, SD}))


def _with_observer(pieces: Pieces, name: str, parameters: Mapping[str, float], config: StreamConfig) -> Pieces:
    needed = {channel.name for channel in config.channels} & set(INPUTS)

    def added(channels: Iterable[str]) -> Iterator[Capture]:
        estimators = Estimators([name], parameters, config)
        for capture in pieces(channels=(set(channels) | needed) - {ANGLE}):
            estimators.edges(capture.edges)
            theta = estimators.samples(capture.samples)[name].theta
            samples = capture.samples
            more = replace(samples.config, channels=(*samples.config.channels, CHANNELS[0]))
            yield replace(capture, samples=with_columns(samples, more, (theta,)))

    return added


def _words(told: ByEdges, given: bool) -> str:
    """What it is, for people; `given`: whether somebody has told the pole pairs."""
    late, error = (1e6 * value for value in told.late)
    kind = f"{told.kind} edges only" if told.kind else "all edges"
    why = f" (rising ones come {late:.0f} ± {error:.0f} us after falling ones)" if told.kind else ""
    turns = f"{told.n_p} electrical turns, after which they repeat" if told.n_p else "whole electrical turns"
    turns = f"whole turns of the shaft, {told.n_p} pole pairs" if told.n_p and given else turns
    return f"its own edges, {kind}{why}, over {turns}"


def _stated(told: ByEdges) -> dict[str, Any]:
    late, error = (None if math.isnan(value) else value for value in told.late)
    return {
        "edges": told.kind or "all", "pole_pairs": told.n_p or None,
        "rising_after_falling_s": late, "rising_after_falling_sd_s": error,
    }  # fmt: skip
