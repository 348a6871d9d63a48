"""What freezes a capture, as people write it: `i_q > 4`, `status changes`, `pulse < 5 us`, `fault`."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from bench.errors import BenchError
from protocol.descriptor import Channel
from protocol.messages import CaptureTrigger
from protocol.text import did_you_mean

FORMS = (
    "'i_q > 4', 'i_q < -4', 'i_q rises 4', 'i_q falls 4', 'status changes', 'pulse < 5 us', fault, state, illegal, now"
)
_ALONE = {kind.name.lower(): kind for kind in (
    CaptureTrigger.NOW, CaptureTrigger.FAULT, CaptureTrigger.STATE, CaptureTrigger.ILLEGAL,
)}  # fmt: skip
_COMPARED = {
    ">": CaptureTrigger.ABOVE, "<": CaptureTrigger.BELOW, "rises": CaptureTrigger.RISES, "falls": CaptureTrigger.FALLS,
}  # fmt: skip
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_FORM = re.compile(
    rf"(?P<channel>[^\s<>=()]+)\s*(?P<how><=|>=|<|>|\b[a-z]+\b)\s*(?P<value>{_NUMBER})?\s*(?P<unit>(?:1/)?[^\s\d.+-]\S*)?"
)
KINDS = {
    CaptureTrigger.NOW: "now", CaptureTrigger.ABOVE: "a channel above a level",
    CaptureTrigger.BELOW: "a channel below a level", CaptureTrigger.RISES: "a channel that rises above a level",
    CaptureTrigger.FALLS: "a channel that falls below a level", CaptureTrigger.CHANGES: "a change of a channel",
    CaptureTrigger.FAULT: "a fault", CaptureTrigger.STATE: "a change of state",
    CaptureTrigger.ILLEGAL: "an illegal Hall code", CaptureTrigger.PULSE: "a short pulse on a Hall wire",
    CaptureTrigger.OFF: "nothing",
}  # fmt: skip
"""What a drive says of a trigger that it was given: neither its channel nor its level."""
_ONE_SIGN = "a drive compares a channel as it is, and with > or < only: give one sign, such as 'i_q > 4'"


@dataclass(frozen=True)
class Trigger:
    """`text` as it was written; `channel` is empty where there is none, `level` in the channel's unit, or in s."""

    text: str
    kind: CaptureTrigger
    channel: str = ""
    level: float = 0.0
    unit: str = ""
    """Of `level`, where somebody has said it."""

    @classmethod
    def parse(cls, text: str) -> Trigger:
        """Read one of `FORMS`. Raises BenchError that says what is wrong with it."""
        words = text.strip()
        if (alone := _ALONE.get(words.lower())) is not None:
            return cls(words, alone)
        found = _FORM.fullmatch(words)
        if found is None:
            why = _ONE_SIGN if "abs(" in words else f"a drive knows {FORMS}"
            raise BenchError(f"'{words}' is no trigger of a capture: {why}")
        channel, how, unit = found["channel"], found["how"], found["unit"] or ""
        if how == "changes" and found["value"] is None and not unit:
            return cls(words, CaptureTrigger.CHANGES, channel)
        if how in ("<=", ">="):
            raise BenchError(f"'{words}' is no trigger of a capture: {_ONE_SIGN}")
        if how not in _COMPARED:
            hint = "say 'rises' or 'falls'" if how == "crosses" else f"a drive knows {FORMS}"
            raise BenchError(f"'{words}' is no trigger of a capture: {hint}")
        level = float(found["value"] or math.nan)
        if not math.isfinite(level):
            raise BenchError(f"'{words}' is no trigger of a capture: give a finite number after the comparison")
        if channel == "pulse" and how == "<":
            if unit not in _SECONDS:
                raise BenchError(f"'{words}': give the length of a pulse with its unit, such as 'pulse < 5 us'")
            return cls(words, CaptureTrigger.PULSE, "", level * _SECONDS[unit])
        return cls(words, _COMPARED[how], channel, level, unit)

    def channel_of(self, channels: tuple[Channel, ...]) -> Channel | None:
        """The channel that it looks at, among the drive's; None where it looks at none.

        BenchError where the drive has none of that name, or in another unit.
        """
        if not self.channel:
            return None
        names = [channel.name for channel in channels]
        found = next((channel for channel in channels if channel.name == self.channel), None)
        if found is None:
            hint = did_you_mean(self.channel, names, f"it has {', '.join(names)}")
            raise BenchError(f"--trigger '{self.text}': the drive has no channel '{self.channel}': {hint}")
        if self.unit and self.unit != found.unit.symbol:
            own = f"in {found.unit.symbol}" if found.unit.symbol else "a pure number"
            raise BenchError(f"--trigger '{self.text}': {self.channel} is {own}, not in {self.unit}")
        return found
