"""What a run says of its CAN bus: load, foreign traffic, errors. Nothing on a byte link."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from bench.device.client import Client
from protocol.canmap.host import CanWire


class BusMeter:
    """The load of the client's bus, and what is counted on it, from now on."""

    def __init__(self, client: Client) -> None:
        self._client = client
        wire = client.session.wire
        self._wire = wire if isinstance(wire, CanWire) else None
        self._since = client.now()
        self._busy = 0.0 if self._wire is None else self._wire.busy_seconds
        self._before = self._counts()

    def _counts(self) -> dict[str, dict[str, int]]:
        """All counts since the link was made: of the bus, of errors by kind, of the adapter."""
        health = getattr(self._client.link, "health", None)  # a link in virtual time has no adapter
        adapter = ("dropped", "malformed", "refused")
        return {
            "bus": {} if self._wire is None else asdict(self._wire.counters),
            "errors": {} if health is None else dict(health.error_frames),
            "adapter": {} if health is None else {name: getattr(health, name) for name in adapter},
        }

    def report(self, predicted: float = 0.0) -> dict[str, Any] | None:
        """The figures as plain data; None on a byte link. `predicted`: the load that the device foresaw at most."""
        wire = self._wire
        if wire is None:
            return None
        seconds = self._client.now() - self._since
        risen = {
            kind: {name: n - self._before[kind].get(name, 0) for name, n in counts.items()}
            for kind, counts in self._counts().items()
        }
        return {
            "rates": str(wire.rates),
            "load": (wire.busy_seconds - self._busy) / seconds if seconds > 0 else 0.0,
            "load_predicted": predicted,
            **risen["bus"],
            "errors": {kind: n for kind, n in risen["errors"].items() if n},
            "adapter": risen["adapter"],
            "bus_off": bool(getattr(getattr(self._client.link, "health", None), "bus_off", False)),
        }


def bus_rows(bus: dict[str, Any]) -> list[list[str]]:
    """The same as pairs of name and text."""
    at_most = bus["load_predicted"]
    predicted = f", at most {at_most:.1%} predicted for the drive's streams" if at_most else ""
    errors = ", ".join(f"{n} {kind}" for kind, n in bus["errors"].items()) or f"{bus['error_frames']} error frames"
    if bus["bus_off"]:
        errors += "; the adapter is off the bus"
    rows = [
        ["bus", f"{bus['rates']}, load {bus['load']:.1%} measured{predicted}"],
        ["errors on the bus", errors],
        [
            "transfers",
            f"{bus['aborted']} aborted, {bus['bad_crc'] + bus['bad_length']} damaged; {bus['orphans']} stray frames",
        ],
        [
            "other frames",
            f"{bus['foreign']} foreign, {bus['stale']} of no stream, {bus['duplicates']} doubled, "
            f"{bus['overdue']} without time",
        ],
    ]
    if bus["adapter"]:
        counts = ", ".join(f"{n} {name}" for name, n in bus["adapter"].items())
        rows.append(["adapter", counts])
    return rows
