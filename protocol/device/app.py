"""What a drive must be able to do to stand behind a `DeviceSession`.

This module holds only the interface and the identity; it never acts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from protocol.framing import MAX_PAYLOAD
from protocol.messages import DriveState, Fault, Feature, Role, SetpointMode
from protocol.signals import Parameter, Signal


@dataclass(frozen=True, slots=True)
class Identity:
    """What HELLO says of a device. `boot_id` differs from boot to boot; tick_hz is a multiple of pwm_hz.

    `tick0`, in the replies to STREAM_SET: the tick of PWM period 0. `name` and `firmware` are cut to 16 bytes, `serial`
    and `build` to 24. `capture_bytes`: memory for captures. Of `features`, those are told for which there is what they
    need: memory for CAPTURE, and of the app what `Extras` has for MEANINGS and WAVEFORM.
    """

    node: int
    role: Role
    name: str
    firmware: str
    boot_id: int
    tick_hz: int = 20_000_000
    pwm_hz: int = 16_000
    features: Feature = Feature.EDGES
    rx_max: int = MAX_PAYLOAD
    tx_max: int = MAX_PAYLOAD
    tick0: int = 0
    serial: str = ""
    build: str = ""
    capture_bytes: int = 0


class DeviceApp(Protocol):
    """The drive itself. The session checks ranges, flags and states before it calls.

    A method may refuse with `protocol.errors.Refused`, whose code and detail go to the host.
    """

    @property
    def channels(self) -> Sequence[Signal]:
        """What can be streamed, in the order of the samples' fields."""

    @property
    def parameters(self) -> Sequence[Parameter]:
        """What can be read and set; one named `watchdog` (s), if there, sets the watchdog."""

    @property
    def outputs_on(self) -> bool:
        """Whether the power stage is on, as the hardware has it."""

    def enter_state(self, state: DriveState) -> None:
        """Follow a change of state: outputs on in RUNNING, at zero current, off in all others.

        May refuse ARMED and RUNNING; the state then stays.
        """

    def clear_faults(self, faults: Fault) -> Fault:
        """Forget latched faults; return those whose cause is still there (then none is cleared)."""

    def setpoint(self, mode: SetpointMode, value: float, value2: float) -> None:
        """Use a setpoint (finite numbers, RUNNING); refuse modes and values that are not allowed."""

    def get_param(self, name: str) -> float:
        """Return a parameter's value as used: a float32."""

    def default_param(self, name: str) -> float:
        """Return the value that the parameter had out of the box."""

    def set_param(self, name: str, value: float) -> None:
        """Use a parameter's new value, a float32 within its range; at the end of RUNNING a VOLATILE one's default."""

    def commit(self) -> None:
        """Store all parameters for the next boot; refuse with NOT_SUPPORTED or STORE_FAILED."""


class Extras(NamedTuple):
    """What an app may have besides what `DeviceApp` asks of it, as attributes of these names."""

    meanings: Mapping[str, str] = {}
    """What channels and parameters mean, by name: blob 3."""
    waveform: NDArray[np.int16] | None = None
    """Memory that a host writes and the app reads in each period: blob 4."""
    fault_channels: Sequence[str] = ()
    """Names of the channels of the capture that waits for a fault unasked; none = from the descriptor's beginning."""

    @classmethod
    def of(cls, app: DeviceApp) -> Extras:
        """Return what an app has of them."""
        return cls(**{name: getattr(app, name) for name in cls._fields if hasattr(app, name)})

    def features(self, identity: Identity) -> Feature:
        """Return those of the identity's features for which there is what they need."""
        lacking = Feature(0)
        if not identity.capture_bytes:
            lacking |= Feature.CAPTURE
        if not self.meanings:
            lacking |= Feature.MEANINGS
        if self.waveform is None:
            lacking |= Feature.WAVEFORM
        return identity.features & ~lacking
