"""A recording as the scoreboard sees it: the encoder's angle, the shaft's phases, and every estimate beside them.

The estimates are the drive's own channels, those that a replay has added, and those of observers that are run here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.analysis.channels import reference_angle
from bench.analysis.chunks import contiguous, part
from bench.analysis.position import states
from bench.errors import BenchError
from bench.observers.estimators import Estimate, Estimators, all_for
from bench.observers.replay import ENDS_EARLY, not_replayable, readable_run
from bench.rerunio.recording import Run
from bench.rerunio.salvage import ends_early
from bench.rerunio.schema import HOST_SUFFIX
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

    path: Path
    rate: float
    """Samples a second."""
    pole_pairs: int
    stretches: tuple[Stretch, ...]
    kinds: dict[str, str]
    step_ns: dict[str, float]
    """What a step of each observer run here took on this machine, beside the front end's."""
    front_ns: float | None
    started: str
    """Date and time of the recording, as it tells them."""
    recorded_by: str
    """Version of the host that recorded it; empty if it does not tell."""
    dropped: int
    """Samples in stretches too short to be of use."""
    lost: int
    restarts: dict[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def samples(self) -> int:
        """How many are scored, those at rest included."""
        return sum(len(stretch.t) for stretch in self.stretches)


def load(path: Path, names: Sequence[str] | None) -> Track:
    """Read a recording and run the observers `names` on it; None: all that the drive's parameters suffice for.

    Raises BenchError where it has no encoder, no samples, or a clock that goes back.
    """
    run = readable_run(path)
    samples = run.samples
    reference = reference_angle(samples.config.channels)
    if not reference:
        raise BenchError(f"{path} cannot be scored: no reference angle; there must be an encoder: record theta_enc")
    notes = [ENDS_EARLY] if ends_early(path) else []
    rate = run.info.pwm_hz / samples.config.decimation
    if (fastest := _fastest(run)) >= math.pi * rate:
        raise BenchError(
            f"{path} cannot be scored: at {rate:g} samples a second an electrical speed of {fastest:.0f} rad/s is half "
            f"a turn or more from one to the next, which is ambiguous: record at --rate {fastest / 2:.0f} or more"
        )
    found, kinds = _recorded(samples)
    estimators = None
    if why := not_replayable(run):
        notes.append(f"no observer could be run on it: {why}")
    else:
        if names is None:
            names, left_out = all_for(run.info.parameters)
            notes += [f"left out, {words}" for words in left_out]
        if names:
            estimators = Estimators(names, run.info.parameters, run.info.tick_hz, run.info.pwm_hz)
            found |= _run_again(run, estimators)
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
    pole_pairs = run.info.n_p or 1
    if run.info.n_p is None:
        notes.append("the pole pairs are not known: r/min are electrical")
    stretches, dropped = [], 0
    theta = samples.physical(reference)
    t = samples.tick / run.info.tick_hz
    for rows in contiguous(samples):
        if rows.stop - rows.start < LEAST * rate:
            dropped += rows.stop - rows.start
            continue
        omega = speed_of(theta[rows], rate)
        stretches.append(
            Stretch(
                t[rows],
                theta[rows],
                omega,
                phases_of(omega, usable[rows], rate, pole_pairs),
                {name: Estimate(e.theta[rows], e.omega[rows]) for name, e in found.items()},
            )
        )
    return Track(
        path=path,
        rate=rate,
        pole_pairs=pole_pairs,
        stretches=tuple(stretches),
        kinds=kinds,
        step_ns={} if estimators is None else {n: 1e9 * s / estimators.steps for n, s in estimators.seconds.items()},
        front_ns=None if estimators is None else 1e9 * estimators.front_seconds / estimators.steps,
        started=run.info.started,
        recorded_by=str(run.info.identity.get("hallbench", "")),
        dropped=dropped,
        lost=sum(gap.lost_samples for gap in samples.gaps),
        restarts={} if estimators is None else estimators.restarts,
        notes=tuple(notes),
    )


def _fastest(run: Run) -> float:
    """The largest electrical speed that the recording tells, rad/s: the reference's, or the largest estimate.

    Without either it is what the drive permits, and 0 where it does not tell.
    """
    channels = [c for c in run.samples.config.channels if c.unit == Unit.RAD_PER_S]
    for flag in (Flag.REFERENCE, Flag.ESTIMATE):
        if told := [c.name for c in channels if c.flags & flag]:
            return max(float(np.abs(run.samples.physical(name)).max()) for name in told)
    return (run.info.n_p or 1) * run.info.parameters.get("omega_m_max", 0.0)


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


def _run_again(run: Run, estimators: Estimators) -> dict[str, Estimate]:
    estimators.edges(run.edges)
    n = len(run.samples)
    pieces = [estimators.samples(part(run.samples, k, min(k + PIECE, n))) for k in range(0, n, PIECE)]
    return {
        name: Estimate(np.concatenate([p[name].theta for p in pieces]), np.concatenate([p[name].omega for p in pieces]))
        for name in (entry.name for entry in estimators.entries)
    }
