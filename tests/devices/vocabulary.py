"""What a device calls its channels and parameters: tables, from which its descriptor and its samples are made."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import pi

import numpy as np

from tests.devices.motor import Samples, phases
from tests.devices.spec import Feature, Flag, Mode, Raw, Unit

Values = Callable[[Samples], np.ndarray]
ANGLE = pi / 32768
NO_FLAGS, NO_FEATURES = Flag(0), Feature(0)
RECORD = struct.Struct("<HBBHHff16s")


@dataclass(frozen=True)
class Channel:
    """`values`: physical values of the samples."""

    id: int
    name: str | bytes
    raw: Raw
    unit: Unit
    flags: Flag
    scale: float
    values: Values

    def record(self) -> bytes:
        return _record(self.id, self.raw, self.unit, Flag.CHANNEL | self.flags, self.scale, self.name)

    def sampled(self, samples: Samples) -> np.ndarray:
        """Raw values, in the type of the descriptor; angles wrap, all others are clipped."""
        raw = self.values(samples) / self.scale
        if self.raw == Raw.F32:
            return raw.astype(self.raw.dtype)
        limits = np.iinfo(self.raw.dtype)
        whole = np.rint(np.nan_to_num(raw))
        if self.flags & Flag.WRAPS:
            whole = (whole - limits.min) % (limits.max - limits.min + 1) + limits.min
        return np.clip(whole, limits.min, limits.max).astype(self.raw.dtype)


@dataclass(frozen=True)
class Parameter:
    """`lo` and `hi` are float32 values, as SPEC chapter 9 asks."""

    id: int
    name: str | bytes
    value: float
    lo: float
    hi: float
    unit: Unit = Unit.NONE
    flags: Flag = NO_FLAGS

    def record(self) -> bytes:
        return _record(self.id, Raw.F32, self.unit, Flag.PARAMETER | self.flags, 1.0, self.name)


@dataclass(frozen=True)
class Vocabulary:
    """All that a device says of itself."""

    name: str | bytes
    firmware: str | bytes
    channels: tuple[Channel, ...]
    parameters: tuple[Parameter, ...]
    features: Feature = NO_FEATURES
    modes: tuple[Mode, ...] = (Mode.SPEED,)
    pole_pairs: int = 4
    """Of the motor itself; what a parameter `n_p` says of it is another matter."""
    serial: str | bytes = ""
    build: str | bytes = ""

    def without(self, *names: str, features: Feature | None = None) -> Vocabulary:
        """The same less these channels and parameters, and with these features only."""
        return replace(
            self,
            channels=tuple(row for row in self.channels if row.name not in names),
            parameters=tuple(row for row in self.parameters if row.name not in names),
            features=self.features if features is None else features,
        )

    def descriptor(self) -> bytes:
        return b"".join(row.record() for row in (*self.channels, *self.parameters))


def _record(number: int, raw: int, unit: int, flags: int, scale: float, name: str | bytes) -> bytes:
    return RECORD.pack(number, raw, unit, flags, 0, scale, 0.0, encoded(name))


def encoded(text: str | bytes) -> bytes:
    return text.encode() if isinstance(text, str) else text


def _full_channels() -> tuple[Channel, ...]:
    none, estimate, reference, wraps = NO_FLAGS, Flag.ESTIMATE, Flag.REFERENCE, Flag.WRAPS
    rows: tuple[tuple[str, Raw, Unit, Flag, float, Values], ...] = (
        ("hall", Raw.U8, Unit.NONE, none, 1, lambda s: s.hall),
        ("status", Raw.U8, Unit.NONE, none, 1, lambda s: s.status),
        ("theta_enc", Raw.I16, Unit.RAD, reference | wraps, ANGLE, lambda s: s.theta_enc),
        ("omega_enc", Raw.I16, Unit.RAD_PER_S, reference, 0.125, lambda s: s.omega_enc),
        ("i_a", Raw.I16, Unit.A, none, 1 / 1024, lambda s: phases(s.current)[0]),
        ("i_b", Raw.I16, Unit.A, none, 1 / 1024, lambda s: phases(s.current)[1]),
        ("i_c", Raw.I16, Unit.A, none, 1 / 1024, lambda s: phases(s.current)[2]),
        ("u_alpha", Raw.I16, Unit.V, none, 1 / 1024, lambda s: s.voltage.real),
        ("u_beta", Raw.I16, Unit.V, none, 1 / 1024, lambda s: s.voltage.imag),
        ("u_dc", Raw.F32, Unit.V, none, 1, lambda s: s.u_dc),
        ("i_d", Raw.I16, Unit.A, none, 1 / 1024, lambda s: s.i_dq.real),
        ("i_q", Raw.I16, Unit.A, none, 1 / 1024, lambda s: s.i_dq.imag),
        ("omega_ref", Raw.I16, Unit.RAD_PER_S, none, 0.125, lambda s: s.omega_ref),
        ("theta_avg", Raw.I16, Unit.RAD, estimate | wraps, ANGLE, lambda s: s.estimate + 0.05),
        ("omega_avg", Raw.I16, Unit.RAD_PER_S, estimate, 0.125, lambda s: s.omega),
        ("theta_vt", Raw.I16, Unit.RAD, estimate | wraps, ANGLE, lambda s: s.estimate),
        ("omega_vt", Raw.I16, Unit.RAD_PER_S, estimate, 0.125, lambda s: s.omega),
    )
    return tuple(Channel(number, *row) for number, row in enumerate(rows, 1))


FULL = Vocabulary(
    name="test device",
    firmware="1.0 full",
    channels=_full_channels(),
    parameters=(
        Parameter(101, "n_p", 4, 1, 64, flags=Flag.IDLE_ONLY | Flag.WHOLE),
        Parameter(102, "R_s_hat", 0.5, 2.0**-10, 128, Unit.OHM),
        Parameter(103, "L_s_hat", 0.001, 2.0**-16, 1, Unit.H),
        Parameter(104, "psi_f_hat", 0.01, 2.0**-16, 8, Unit.VS),
        Parameter(105, "i_max", 10, 0, 30, Unit.A, Flag.IDLE_ONLY),
        Parameter(106, "omega_m_max", 400, 0, 600, Unit.RAD_PER_S, Flag.IDLE_ONLY),
        Parameter(107, "alpha_m_max", 2000, 1, 100000, Unit.RAD_PER_S2),
        Parameter(108, "observer", 2, 0, 2, flags=Flag.WHOLE),
        Parameter(125, "watchdog", 1, 2.0**-4, 1, Unit.S, Flag.IDLE_ONLY),
    ),
    features=Feature.EDGES,
    modes=(Mode.SPEED, Mode.CURRENT),
    serial="33FFD8054D48383611571943",
    build="9f2c61e-dirty",
)
"""Names of the simulated drive, as far as a drive without its plant can have them."""

OWN = Vocabulary(
    name="gate-drv 7",
    firmware="r42",
    channels=(
        Channel(3, "v_bus", Raw.F32, Unit.V, NO_FLAGS, 1.0, lambda s: s.u_dc),
        Channel(8, "w_target", Raw.F32, Unit.RAD_PER_S, NO_FLAGS, 1.0, lambda s: s.omega_ref),
        Channel(5, "w_meas", Raw.F32, Unit.RAD_PER_S, Flag.ESTIMATE, 1.0, lambda s: s.omega),
        Channel(20, "pos_e", Raw.I16, Unit.RAD, Flag.ESTIMATE | Flag.WRAPS, ANGLE, lambda s: s.estimate),
        Channel(11, "temp_fet", Raw.I16, Unit.NONE, NO_FLAGS, 0.125, lambda s: 41.0 + 0.01 * np.abs(s.omega)),
        Channel(1, "duty", Raw.U8, Unit.NONE, NO_FLAGS, 1 / 255, lambda s: np.abs(s.voltage) / s.u_dc),
    ),
    parameters=(
        Parameter(1, "kp_w", 0.25, 0, 16),
        Parameter(2, "ki_w", 4, 0, 256),
        Parameter(9, "vbus_min", 18, 0, 60, Unit.V),
    ),
)
"""A drive of its own names: no encoder, no edges, no currents, ids in no order."""

VOCABULARIES = {"full": FULL, "own": OWN}
