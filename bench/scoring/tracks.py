"""A recording as the scoreboard sees it: the encoder's angle, the shaft's phases, and every estimate beside them.

The estimates are the drive's own channels, those that a replay has added, and those of observers that are run here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.analysis.capture import Capture
from bench.analysis.channels import reference_angle
from bench.analysis.chunks import contiguous, part
from bench.analysis.delays import blame, delays
from bench.analysis.position import states
from bench.analysis.units import pole_pairs
from bench.errors import BenchError
from bench.observers.estimators import Estimate, Estimators, all_for
from bench.observers.replay import ENDS_EARLY, not_replayable, readable_run
from bench.recording.info import HOST_SUFFIX
from bench.recording.reader import capture_of
from bench.scoring.phases import Phases, phases_of, speed_of
from protocol.messages import DriveState
from protocol.signals import Flag, Unit
from protocol.streams import SampleChunk

F64 = NDArray[np.float64]
PIECE = 1 << 17  # samples that observers are run on at a time: what bounds the memory
LEAST = 0.1  # s, shorter stretches between two losses are left out
DRIVE, REPLAYED, HOST = "drive", "replayed", "host"


@dataclass(frozen=True)
class Stretch:
    """n samples without a gap. Angles in electrical rad, speeds in electrical rad/s, (n,) each."""

    t: F64  # s of device time
    theta: F64
    omega: F64
    phases: Phases
    estimates: dict[str, Estimate]


@dataclass(frozen=True)
class Track:
    """One recording. `kinds`: who made each estimate."""

    path: str
    rate: float
    """Samples a second."""
    pole_pairs: int
    stretches: tuple[Stretch, ...]
    kinds: dict[str, str]
    step_ns: dict[str, float]
    """What a step of each observer run here took on this machine, beside the front end's."""
    front_ns: float | None
    dropped: int
    """Samples in stretches too short to be of use."""
    lost: int
    started: str = ""
    """Date and time of the recording, as it tells them."""
    recorded_by: str = ""
    """Version of the host that recorded it; empty if it does not tell."""
    restarts: dict[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def samples(self) -> int:
        """How many are scored, those at rest included."""
        return sum(len(stretch.t) for stretch in self.stretches)


def load(source: Path | Capture, names: Sequence[str] | None) -> Track:
    """Take a recording or a capture and run the observers `names` on it; None: all that its parameters suffice for.

    Raises BenchError where it has no encoder, no samples, or a clock that goes back.
    """
    if isinstance(source, Capture):
        return _track(source, names, "the capture", [])
    run = readable_run(source)
    capture = capture_of(run)
    track = _track(capture, names, str(source), [*([] if run.ended else [ENDS_EARLY]), *run.damage])
    return replace(track, started=run.info.started, recorded_by=str(run.info.identity.get("hallbench", "")))


def _track(capture: Capture, names: Sequence[str] | None, path: str, notes: list[str]) -> Track:
    samples, parameters = capture.samples, capture.parameters
    reference = reference_angle(samples.config.channels)
    if not reference:
        raise BenchError(f"{path} cannot be scored: no reference angle; there must be an encoder: record theta_enc")
    n_p = pole_pairs(parameters)
    rate = capture.sample_rate
    if (fastest := _fastest(capture)) >= math.pi * rate:
        raise BenchError(
            f"{path} cannot be scored: at {rate:g} samples a second an electrical speed of {fastest:.0f} rad/s is half "
            f"a turn or more from one to the next, which is ambiguous: record at --rate {fastest / 2:.0f} or more"
        )
    found, kinds = _recorded(samples)
    estimators = None
    if why := not_replayable(samples.config, capture.edges.config):
        notes.append(f"no observer could be run on it: {why}")
    else:
        if names is None:
            names, left_out = all_for(parameters)
            notes += [f"left out, {words}" for words in left_out]
        if names:
            estimators = Estimators(names, parameters, samples.config)
            found |= _run_again(capture, estimators)
            kinds |= dict.fromkeys(names, HOST)
    if not found:
        raise BenchError(f"{path} cannot be scored: {'; '.join(notes) or 'it has no estimate of the angle'}")
    usable = np.ones(len(samples), bool)
    if (told := states(samples)) is not None:
        running = told == DriveState.RUNNING
        if running.any():
            usable = running
        else:
            notes.append("the drive was never RUNNING: all samples count")
    if words := blame(delays(capture))[1]:
        notes.append(f"angles differ in time: {words}")
    if n_p is None:
        notes.append("the pole pairs are not known: r/min are electrical")
    kernels = None if estimators is None else estimators.kernels
    stretches, dropped = _stretches(capture, capture[reference], usable, found, n_p or 1)
    return Track(
        path=path,
        rate=rate,
        pole_pairs=n_p or 1,
        stretches=stretches,
        kinds=kinds,
        step_ns={} if kernels is None else {name: 1e9 * s / kernels.steps for name, s in kernels.seconds.items()},
        front_ns=None if kernels is None else 1e9 * kernels.front_seconds / kernels.steps,
        dropped=dropped,
        lost=sum(gap.lost_samples for gap in samples.gaps),
        restarts={} if estimators is None else estimators.restarts,
        notes=tuple(notes),
    )


def _stretches(
    capture: Capture, theta: F64, usable: NDArray[np.bool_], found: dict[str, Estimate], n_p: int
) -> tuple[tuple[Stretch, ...], int]:
    """The stretches without a gap that are long enough, and how many samples are in others."""
    rate, stretches, dropped = capture.sample_rate, [], 0
    for rows in contiguous(capture.samples):
        if rows.stop - rows.start < LEAST * rate:
            dropped += rows.stop - rows.start
            continue
        omega = speed_of(theta[rows], rate)
        estimates = {name: Estimate(e.theta[rows], e.omega[rows]) for name, e in found.items()}
        phases = phases_of(omega, usable[rows], rate, n_p)
        stretches.append(Stretch(capture.t[rows], theta[rows], omega, phases, estimates))
    return tuple(stretches), dropped


def _fastest(capture: Capture) -> float:
    """The largest electrical speed that the recording tells, rad/s: the reference's, or the largest estimate.

    Without either it is what the drive permits, and 0 where it does not tell.
    """
    channels = [c for c in capture.samples.config.channels if c.unit == Unit.RAD_PER_S]
    for flag in (Flag.REFERENCE, Flag.ESTIMATE):
        if told := [c.name for c in channels if c.flags & flag]:
            return max(float(np.abs(capture[name]).max()) for name in told)
    return (pole_pairs(capture.parameters) or 1) * capture.parameters.get("omega_m_max", 0.0)


def _recorded(samples: SampleChunk) -> tuple[dict[str, Estimate], dict[str, str]]:
    """The estimates that are in the stream: those of the drive as drive_<short>, a replay's as replayed_<short>."""
    channels = samples.config.channels
    speeds = {c.name for c in channels if c.flags & Flag.ESTIMATE and c.unit == Unit.RAD_PER_S}
    found: dict[str, Estimate] = {}
    kinds: dict[str, str] = {}
    for channel in channels:
        if not (channel.flags & Flag.ESTIMATE and channel.unit == Unit.RAD):
            continue
        short = channel.name.removeprefix("theta_")
        kind = REPLAYED if short.endswith(HOST_SUFFIX) else DRIVE
        omega = f"omega_{short}"
        known = samples.physical(omega) if omega in speeds else np.full(len(samples), np.nan)
        name = f"{kind}_{short.removesuffix(HOST_SUFFIX)}"
        found[name], kinds[name] = Estimate(samples.physical(channel.name), known), kind
    return found, kinds


def _run_again(capture: Capture, estimators: Estimators) -> dict[str, Estimate]:
    estimators.edges(capture.edges)
    n = len(capture)
    pieces = [estimators.samples(part(capture.samples, k, min(k + PIECE, n))) for k in range(0, n, PIECE)]
    return {
        name: Estimate(np.concatenate([p[name].theta for p in pieces]), np.concatenate([p[name].omega for p in pieces]))
        for name in (entry.name for entry in estimators.entries)
    }
