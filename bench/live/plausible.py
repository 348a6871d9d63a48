"""Whether what a run showed can be a healthy drive's: speed, position error, currents, Hall sensors and encoder.

`Plausibility` is a sink that hands pieces of a run to the detectors of `bench.findings`, bounded in memory, and at the
end names what cannot be right, and what nothing in the stream could show.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from bench.device.heard import Heard
from bench.findings.beats import Beats
from bench.findings.finding import Finding
from bench.findings.motion import BY_ENCODER, BY_ESTIMATE, BY_HALL, Currents, Look, NotFinite, SpeedHeld, far_off
from bench.findings.motor import MotorValues
from bench.findings.passed import Passed
from bench.findings.thresholds import LEAST_TURNS
from bench.live.hall_sensors import HallSensors, Said
from bench.signal.channels import flagged, reference_angle, speed_channel
from bench.signal.position import ErrorTable, last_state
from bench.signal.units import pole_pairs
from bench.signal.waveforms.sectors import SECTOR_WIDTH
from protocol.messages import DriveState
from protocol.signals import Flag, Unit
from protocol.streams import SampleChunk, StreamConfig


def _of_angle(code: str) -> bool:
    """Whether a finding says that the encoder's angle is not the rotor's; a wrong zero alone disturbs nothing."""
    return code.startswith(("encoder", "pole_pairs")) and code != "encoder_zero"


def _explained(finding: Finding, motor: Sequence[Finding]) -> bool:
    """Whether it follows from what is wrong of the motor: the rotor's zero is found with the drive's inductance."""
    return finding.code in ("encoder_zero", "hall_setting") and any(other.code == "inductance" for other in motor)


class Plausibility:
    """Sink that judges the run of a drive by its `stream` of samples and, with `edges`, its Hall edges.

    `parameters`: the drive's, by name, in their units; `threaded`: as for `HallSensors`.
    """

    def __init__(
        self, stream: StreamConfig, edges: bool, parameters: Mapping[str, float], threaded: bool = False
    ) -> None:
        channels = stream.channels
        self._drive, self._rate, self._edges = stream.node, stream.rate, edges
        self._names = {channel.name for channel in channels}
        self._n_p = pole_pairs(parameters)
        self._theta = reference_angle(channels)
        self._both = any(channel.name == self._theta and channel.flags & Flag.ESTIMATE for channel in channels)
        self._omega = flagged(channels, Unit.RAD_PER_S, Flag.REFERENCE)
        self._by = BY_ENCODER if self._omega else BY_HALL if edges else BY_ESTIMATE
        if not self._omega and not edges:
            self._omega = speed_channel(channels, parameters)
        i_max = parameters.get("i_max", math.inf)
        self._passed, self._beats = Passed(stream.node, stream.tick_hz), Beats(stream.node, stream.tick_hz, edges)
        self.commanded = True
        """Whether the drive is told what to do: what it does after STOP is not judged."""
        self.speed, self._currents = SpeedHeld(self._by, self._n_p or 1, i_max), Currents(i_max)
        self._not_finite = NotFinite()
        self.motor = MotorValues(stream, parameters)
        self._named: set[str] = set()  # codes of what was told
        self._last = (0, 0)  # ticks of the newest chunk
        self.hall = HallSensors(stream, edges, parameters, threaded)

    # -- sink ---------------------------------------------------------------------------------------------------

    def take(self, item: Heard) -> None:
        """Follow the Hall sensors from sector to sector; take in what was sampled while the drive was running."""
        self.hall.take(item)
        self._passed.take(item)
        self._beats.take(item)
        if isinstance(item, SampleChunk) and item.config.node == self._drive:
            self._samples_came(item)

    def _samples_came(self, chunk: SampleChunk) -> None:
        seconds, sectors = self._passed.up_to(int(chunk.tick[-1]))
        self._not_finite.add(chunk)
        state = last_state(chunk)
        if state != DriveState.RUNNING and (state is not None or not self.commanded):
            return
        self._currents.add(chunk)
        self.motor.add(chunk)
        self._last = int(chunk.tick[0]), int(chunk.tick[-1])
        self._look_at_speed(chunk, seconds, sectors)

    def _look_at_speed(self, chunk: SampleChunk, seconds: float, sectors: float) -> None:
        """`sectors` that the Hall edges went on by in `seconds`."""
        if self._n_p is None or not (self._omega or self._edges):
            return
        sampled = len(chunk) / self._rate
        omega = sectors * SECTOR_WIDTH / seconds if seconds else 0.0
        if self._omega:
            seconds, omega = sampled, float(chunk.physical(self._omega).mean())
        current = i_q = math.nan
        if {"i_d", "i_q"} <= self._names:
            current = float(np.hypot(chunk.physical("i_d"), chunk.physical("i_q")).mean())
            i_q = float(chunk.physical("i_q").mean())
        self.speed.add(Look(int(chunk.tick[-1]) / chunk.config.tick_hz, seconds, omega, sampled, current, i_q))

    def news(self) -> Iterator[Said]:
        """What was found since the last call, each once; of the motor, as long as nothing is wrong with its angle."""
        motor = list(self.motor.findings())
        for said in self.hall.news():
            if not _explained(said.finding, motor) and not self._unseen(said.finding):
                self._named.add(said.finding.code)
                yield said
        if not any(map(_of_angle, self._named)):
            for finding in motor:
                if finding.code not in self._named:
                    self._named.add(finding.code)
                    yield Said(finding, *self._last)

    # -- at the end ---------------------------------------------------------------------------------------------

    def implausible(self, errors: ErrorTable) -> list[Finding]:
        """What cannot be right for a healthy drive, each with its numbers; `errors`: position errors of the run."""
        return [
            *self._beats.findings(),
            *self._not_finite.findings(),
            *self.causes(),
            *self.speed.findings(),
            *far_off(errors, self._rate),
            *self._currents.findings(),
        ]

    def at_rest(self) -> list[Finding]:
        """The same of a drive that was only watched."""
        return [*self._beats.findings(), *self._of_hall()]

    def _of_hall(self) -> list[Finding]:
        return [finding for finding in self.hall.findings() if not self._unseen(finding)]

    def _unseen(self, finding: Finding) -> bool:
        """Whether no Hall edge came, of any that the drive has counted: nothing is known of its sensors."""
        return finding.code == "dead" and self._beats.all_lost

    def causes(self) -> list[Finding]:
        """What is set or wired wrongly, by what the shaft showed as it turned; also of a run that ended in a trip."""
        hall = self._of_hall()
        motor = [] if any(_of_angle(finding.code) for finding in hall) else list(self.motor.findings())
        return [*(finding for finding in hall if not _explained(finding, motor)), *motor]

    def unverified(self) -> list[str]:
        """What nothing in the stream could show, each with the reason."""
        unseen, pieces = [], self.hall.pieces
        if not self._theta:
            unseen.append("position error (no angle with the flag REFERENCE)")
        elif self._both:
            unseen.append(f"position error of {self._theta} (it has the flags ESTIMATE and REFERENCE: no other tells)")
        elif pieces.too_fast and self._edges and self.hall.turned < LEAST_TURNS:
            unseen.append("Hall sensors against the encoder (too few samples in an electrical revolution)")
        if pieces.too_late:
            unseen.append("Hall sensors (edges come too late after the samples, or their ticks are wrong)")
        elif self.hall.error:
            unseen.append(f"Hall sensors (they could not be judged: {self.hall.error})")
        if self._n_p is None:
            unseen.append("speed (no parameter n_p)")
        elif not self._omega and not self._edges:
            unseen.append("speed (no encoder, no Hall edges, no estimate of it)")
        elif self._by == BY_ESTIMATE:
            unseen.append("speed, but for the drive's own estimate")
        else:
            unseen += self.speed.unverified()
        return unseen
