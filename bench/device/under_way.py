"""Setpoints that follow each other faster than heartbeats come: sent, not waited for, and looked after meanwhile.

A heartbeat tells the last setpoint that its node took, and how many it rejected. So one that is lost among others costs
nothing, and the last one is sent again until a heartbeat tells of it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from bench.device.client import Client
from protocol.errors import NoReply
from protocol.messages import Heartbeat, Setpoint, SetpointMode

TRIES = 3  # of a setpoint
WAIT = 0.35  # s for a heartbeat that tells of it: three of them


class UnderWay:
    """Setpoints to node `number`; `rejection` makes the error of one that a heartbeat says was rejected."""

    def __init__(self, client: Client, number: int, rejection: Callable[[Heartbeat, Setpoint], Exception]) -> None:
        self._client, self._number, self._rejection = client, number, rejection
        self._rejected: int | None = None  # by the heartbeat before the first
        self._last: Setpoint | None = None
        self._sent: deque[tuple[int, float]] = deque()  # counters that no heartbeat has told yet, and when, s

    def send(self, setpoint: Setpoint) -> None:
        """Send one now."""
        heartbeat = self._client.heartbeats.get(self._number)
        if self._rejected is None and heartbeat is not None:
            self._rejected = heartbeat.setpoints_rejected
        self._last = setpoint
        self._sent.append((setpoint.counter, self._client.now()))
        self._client.session.send(setpoint, self._number)

    def watch(self, again: Callable[[SetpointMode, float, float], None]) -> None:
        """See what heartbeats tell; the last one that was sent is sent `again` where they do not tell of it in time.

        Raises what `rejection` makes, and NoReply where nothing was confirmed for so long.
        """
        heartbeat, now = self._client.heartbeats.get(self._number), self._client.now()
        if heartbeat is None or self._last is None:
            return
        if self._client.health.down_since is not None or self._client.behind:  # what is told will come, or be sent anew
            self._sent = deque((counter, now) for counter, _ in self._sent)
            return
        if self._rejected is not None and heartbeat.setpoints_rejected != self._rejected:
            raise self._rejection(heartbeat, self._last)
        if any(counter == heartbeat.setpoint_counter for counter, _ in self._sent):
            while self._sent.popleft()[0] != heartbeat.setpoint_counter:
                pass
        if self._sent and now - self._sent[0][1] > TRIES * WAIT:
            raise NoReply(f"node {self._number} on {self._client.link.name} confirmed no setpoint in {TRIES} tries")
        if self._sent and now - self._sent[-1][1] > WAIT:
            again(self._last.mode, self._last.value, self._last.value2)
