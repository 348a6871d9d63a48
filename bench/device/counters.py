"""What a node counts itself, as its heartbeats tell it."""

from __future__ import annotations

from protocol.messages import Heartbeat


class DeviceCounters:
    """How far the counters in a node's heartbeats have gone up since the first one; after a reboot they start at 0."""

    def __init__(self) -> None:
        self.risen = {"tx_dropped": 0, "rx_bad": 0, "setpoints_rejected": 0}
        self._last: Heartbeat | None = None

    @property
    def seen(self) -> bool:
        """Whether there was a heartbeat."""
        return self._last is not None

    def following(self) -> DeviceCounters:
        """Counters of what comes next, which begin at 0."""
        new = DeviceCounters()
        new._last = self._last
        return new

    def add(self, heartbeat: Heartbeat) -> None:
        """Take the node's next heartbeat."""
        last, self._last = self._last, heartbeat
        if last is None:
            return
        for name in self.risen:
            before = getattr(last, name) if last.boot_id == heartbeat.boot_id else 0
            self.risen[name] += max(0, getattr(heartbeat, name) - before)
