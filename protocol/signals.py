"""The one table of what a drive can telemeter and which parameters it has.

From it come the simulated drives' descriptors and the tables in SPEC.md. A physical drive may have other channels and
other scales: a host reads the descriptor of the drive it talks to and assumes nothing from this table except the
meaning of names, units and flags.

This module never touches bytes; `protocol.descriptor` packs it.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Self, cast

from protocol.codes import OpenEnum, TestSignal


class RawType(IntEnum):
    """Type of a value on the wire, little-endian."""

    dtype: str
    """Numpy's name of the type, for example `<i2`."""

    def __new__(cls, number: int, dtype: str = "") -> Self:
        """A type and numpy's name of it."""
        made = int.__new__(cls, number)
        made._value_, made.dtype = number, dtype
        return made

    U8 = 1, "|u1"
    I8 = 2, "|i1"
    U16 = 3, "<u2"
    I16 = 4, "<i2"
    U32 = 5, "<u4"
    I32 = 6, "<i4"
    F32 = 7, "<f4"


class Unit(OpenEnum, word="unit"):
    """SI units, by their number on the wire."""

    _symbol: str

    def __new__(cls, number: int, symbol: str = "") -> Self:
        """A unit and how it is written."""
        made = int.__new__(cls, number)
        made._value_, made._symbol = number, symbol
        return made

    NONE = 0
    RAD = 1, "rad"
    RAD_PER_S = 2, "rad/s"
    A = 3, "A"
    V = 4, "V"
    NM = 5, "N·m"
    S = 6, "s"
    HZ = 7, "Hz"
    OHM = 8, "Ω"
    H = 9, "H"
    VS = 10, "V·s"
    KGM2 = 11, "kg·m²"
    COUNT = 12, "counts"
    PER_S = 13, "1/s"
    RAD_PER_S2 = 14, "rad/s²"
    RAD_PER_A = 15, "rad/A"
    RAD_PER_AS = 16, "rad/(A·s)"
    A_S_PER_RAD = 17, "A·s/rad"
    A_PER_RAD = 18, "A/rad"
    DEG_C = 19, "°C"
    W = 20, "W"
    A2S = 21, "A²·s"

    @property
    def symbol(self) -> str:
        """How the unit is written for people; empty for a pure number, `unit 40` for one that is not known here."""
        return getattr(self, "_symbol", self.name)


class Flag(IntFlag):
    """What a descriptor record is, and how a host may use it."""

    CHANNEL = 1  # can be streamed
    PARAMETER = 2  # can be read with PARAM_GET
    TRUTH = 4  # the simulation's own state: no physical drive has it
    ESTIMATE = 8  # a position or speed estimate, to be compared with the reference
    REFERENCE = 16  # the position or speed that estimates are compared with (the encoder)
    WRAPS = 32  # an angle in [-pi, pi)
    READ_ONLY = 64  # a parameter that cannot be set
    IDLE_ONLY = 128  # a parameter that can be set only while the outputs are off
    WHOLE = 256  # a parameter that takes whole numbers only
    ON_REQUEST = 512  # a channel that is streamed only where it is asked for by name
    IDENTITY = 1024  # a parameter that tells which kind of motor this is
    CALIBRATION = 2048  # a parameter that goes with this very motor, its sensors and their mounting
    TUNING = 4096  # a parameter of taste: gains, filters, choices
    LIMITS = 8192  # a parameter that protects
    VOLATILE = 16384  # a parameter that is at its default at boot and whenever RUNNING has ended


@dataclass(frozen=True, slots=True)
class Signal:
    """One channel: physical value = raw * scale + offset, in `unit`."""

    id: int
    name: str
    unit: Unit
    raw: RawType
    scale: float
    flags: Flag
    about: str
    offset: float = 0.0


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter: a float32 in `unit`, allowed from `lo` to `hi` inclusive."""

    id: int
    name: str
    unit: Unit
    lo: float
    hi: float
    flags: Flag
    about: str


class Status(IntFlag):
    """Bits of the channel `status`; bits 0-2 hold the `DriveState`, bits 5-6 the `AngleSource`, 3 for 3 and above."""

    OBSERVERS_RESET = 1 << 3  # the observers were initialised in this period
    CORRECTION_ON = 1 << 4  # the vector-tracking observer's back-EMF correction is at work
    INJECTION_SYNC = 1 << 7  # the injected sine or the test signal begins a cycle with this sample


STATUS_STATE_MASK = 0x07
STATUS_SOURCE_SHIFT = 5
STATUS_SOURCE_MASK = 3 << STATUS_SOURCE_SHIFT
OTHER_SOURCE = 3  # what the two bits say for every angle source that they cannot name


class AngleSource(IntEnum):
    """Values of the parameter `observer`: whose angle and speed the control uses."""

    short: str
    """What channels call it: its angle is `theta_enc`, `theta_avg` …, its speed `omega_enc` …"""

    def __new__(cls, number: int, short: str = "") -> Self:
        """A source and its short name."""
        made = int.__new__(cls, number)
        made._value_, made.short = number, short
        return made

    ENCODER = 0, "enc"
    AVERAGE_SPEED = 1, "avg"
    VECTOR_TRACKING = 2, "vt"
    LOAD_ANGLE = 3, "la"
    SECTOR_CENTRE = 4, "sc"
    LOOKUP_TABLE = 5, "lut"
    HALL_VECTOR = 6, "hv"
    HALL_VECTOR_DECOUPLED = 7, "hvd"
    PROGRAMMABLE_FILTER = 8, "plf"
    VECTOR_TRACKING_Q15 = 9, "q15"
    EDGE_KALMAN = 10, "ek"


SOURCE_NAMES = {source.name.lower().replace("_", "-"): source for source in AngleSource}
"""What people call the angle sources: `encoder`, `average-speed` …"""


class Injection(IntEnum):
    """Values of the parameter `inject`: where the vector-tracking observer adds a sine, to measure (11)."""

    OFF = 0
    BACK_EMF = 1
    HALL = 2


SECTOR_OF_CODE = (-1, 0, 2, 1, 4, 5, 3, -1)
"""Sector 0..5 by Hall code (bit 0 = sensor a, 1 = b, 2 = c); -1: a code that no rotor angle gives."""


class HallSwap(IntEnum):
    """Values of `hall_swap_hat`, and of the load machine's `hall_swap`: which Hall wires are exchanged."""

    NONE = 0
    A_B = 1  # a and b exchanged
    B_C = 2  # b and c exchanged
    C_A = 3  # c and a exchanged
    A_ON_B = 4  # rotated: sensor a on input b, b on c, c on a
    A_ON_C = 5  # rotated the other way: a on c, c on b, b on a


INPUT_OF_SENSOR = ((0, 1, 2), (1, 0, 2), (0, 2, 1), (2, 1, 0), (1, 2, 0), (2, 0, 1))
"""The inputs that sensors a, b, c are on, by `HallSwap`."""


Eight = tuple[int, int, int, int, int, int, int, int]


def hall_map(swap: float, invert: float) -> Eight:
    """The Hall code by what the three inputs read, 0..7, for a drive's `hall_swap_hat` and `hall_invert_hat`."""
    inputs = INPUT_OF_SENSOR[int(swap)]
    codes = (sum(((pins ^ int(invert)) >> at & 1) << k for k, at in enumerate(inputs)) for pins in range(8))
    return cast("Eight", tuple(codes))


# Scales are float32 on the wire: what both ends compute with is the float32 value.
ANGLE = struct.unpack("f", struct.pack("f", math.pi / 32768))[0]  # rad a count: an i16 covers [-pi, pi)
SPEED = 0.125  # electrical rad/s a count
MILLI = 1.0 / 1024  # A or V a count
NANO = 2.0**-30  # s a count


def _channel(
    id: int, name: str, unit: Unit, scale: float, about: str, flags: Flag = Flag.CHANNEL, raw: RawType = RawType.I16
) -> Signal:
    return Signal(id, name, unit, raw, scale, Flag.CHANNEL | flags, about)


def _on_request(id: int, name: str, unit: Unit, scale: float, about: str, raw: RawType = RawType.I16) -> Signal:
    return _channel(id, name, unit, scale, about, Flag.ON_REQUEST, raw)


def estimate_channels(id: int, short: str, about: str) -> tuple[Signal, Signal]:
    """The angle (channel `id`) and the speed (`id` + 1) of an observer, for those who ask for them."""
    flags = Flag.ESTIMATE | Flag.ON_REQUEST
    return (
        _channel(id, f"theta_{short}", Unit.RAD, ANGLE, f"estimate: {about}", flags | Flag.WRAPS),
        _channel(id + 1, f"omega_{short}", Unit.RAD_PER_S, SPEED, f"speed: {about}", flags),
    )


_SENSORS = "Kalman filter: Hall sensors a, b, c distrusted (bits 0-2), moved (bits 3-5), lost (6)"
_LESSON = "which parameter lesson_value_ek is for: each in turn (see below)"
_LESSON_VALUE = "value that the Kalman filter learned for this parameter, in its unit"

DRIVE_CHANNELS: tuple[Signal, ...] = (
    _channel(1, "hall", Unit.NONE, 1.0, "Hall code: bit 0 = sensor a, bit 1 = b, bit 2 = c", raw=RawType.U8),
    _channel(2, "status", Unit.NONE, 1.0, "drive state, angle source and observer events (see Status)", raw=RawType.U8),
    _channel(3, "theta_enc", Unit.RAD, ANGLE, "electrical angle by the encoder", Flag.REFERENCE | Flag.WRAPS),
    _channel(4, "omega_enc", Unit.RAD_PER_S, SPEED, "electrical speed by the encoder, filtered", Flag.REFERENCE),
    _channel(5, "i_a", Unit.A, MILLI, "phase current a, into the motor"),
    _channel(6, "i_b", Unit.A, MILLI, "phase current b"),
    _channel(7, "i_c", Unit.A, MILLI, "phase current c"),
    _channel(8, "u_alpha", Unit.V, MILLI, "voltage reference alpha, applied in the PWM period up to this sample"),
    _channel(9, "u_beta", Unit.V, MILLI, "voltage reference beta, likewise"),
    _channel(10, "u_dc", Unit.V, MILLI, "DC link voltage", raw=RawType.U16),
    _channel(11, "i_d", Unit.A, MILLI, "d current in the controller's frame"),
    _channel(12, "i_q", Unit.A, MILLI, "q current in the controller's frame"),
    _channel(13, "i_d_ref", Unit.A, MILLI, "reference of i_d, applied in the PWM period up to this sample"),
    _channel(14, "i_q_ref", Unit.A, MILLI, "reference of i_q, applied in the PWM period up to this sample"),
    _channel(15, "omega_ref", Unit.RAD_PER_S, SPEED, "electrical speed reference after the ramp"),
    _channel(16, "theta_avg", Unit.RAD, ANGLE, "average-speed estimate, (1)-(2)", Flag.ESTIMATE | Flag.WRAPS),
    _channel(17, "omega_avg", Unit.RAD_PER_S, SPEED, "average speed omega_h, (1)", Flag.ESTIMATE),
    _channel(18, "theta_vt", Unit.RAD, ANGLE, "vector-tracking estimate, (3)-(10)", Flag.ESTIMATE | Flag.WRAPS),
    _channel(19, "omega_vt", Unit.RAD_PER_S, SPEED, "vector-tracking speed, low-pass filtered", Flag.ESTIMATE),
    _channel(20, "delta_hat", Unit.RAD, ANGLE, "load-angle estimate, (18)"),
    _channel(21, "e_alpha", Unit.V, MILLI, "filtered back-EMF alpha of the vector-tracking observer, (6)"),
    _channel(22, "e_beta", Unit.V, MILLI, "filtered back-EMF beta, likewise"),
    _channel(23, "theta_true", Unit.RAD, ANGLE, "true electrical angle (simulated drive)", Flag.TRUTH | Flag.WRAPS),
    _channel(24, "omega_true", Unit.RAD_PER_S, SPEED, "true electrical speed (simulated drive)", Flag.TRUTH),
    _channel(25, "tau_e_true", Unit.NM, 1 / 16384, "true electromagnetic torque (simulated drive)", Flag.TRUTH),
    _channel(26, "tau_load_true", Unit.NM, 1 / 16384, "torque of the load machine on the shaft", Flag.TRUTH),
    *estimate_channels(27, "la", "vector tracking with load-angle compensation, (18)-(19)"),
    *estimate_channels(29, "sc", "the centre of the Hall sector"),
    *estimate_channels(31, "lut", "average speed with the table of edges [15]"),
    *estimate_channels(33, "hv", "vector tracking of the Hall vector [16]"),
    *estimate_channels(35, "hvd", "the same, harmonics decoupled [17]"),
    *estimate_channels(37, "plf", "rotor flux by the programmable filter [18]"),
    *estimate_channels(39, "q15", "vector tracking in 16-bit integers"),
    *estimate_channels(41, "ek", "Kalman filter on Hall edges and back-EMF"),
    _on_request(43, "sensors_ek", Unit.NONE, 1.0, _SENSORS, RawType.U8),
    _on_request(44, "sigma_ek", Unit.RAD, ANGLE, "standard deviation of theta_ek, by the filter itself"),
    _on_request(45, "dead_time_left", Unit.S, NANO, "dead time learned by dead_time_learn"),
    _on_request(46, "dead_time_near", Unit.S, NANO, "extra dead time learned near zero current"),
    _on_request(47, "lesson_ek", Unit.NONE, 1.0, _LESSON, RawType.U8),
    _on_request(48, "lesson_value_ek", Unit.NONE, 1.0, _LESSON_VALUE, RawType.F32),
    _on_request(49, "lesson_sigma_ek", Unit.NONE, 1.0, "standard deviation of lesson_value_ek", RawType.F32),
    _channel(50, "theta_ctrl", Unit.RAD, ANGLE, "electrical angle that the control used", Flag.ON_REQUEST | Flag.WRAPS),
)

LESSONS = (
    *(f"edge_{way}_{sector}" for way in ("up", "down") for sector in range(1, 7)),
    *("psi_f_hat", "R_s_hat", "L_s_hat"),
)
"""Parameters that the Kalman filter on Hall edges learns better values of, by their number in `lesson_ek`."""

LOAD_CHANNELS: tuple[Signal, ...] = (
    _channel(1, "omega_m", Unit.RAD_PER_S, 1.0, "mechanical speed of the shaft", raw=RawType.F32),
    _channel(2, "tau_load", Unit.NM, 1.0, "torque against the drive's positive direction", raw=RawType.F32),
    _channel(3, "status", Unit.NONE, 1.0, "state of the load machine, bits 0-2", raw=RawType.U8),
)

_P = Flag.PARAMETER
_PI = Flag.PARAMETER | Flag.IDLE_ONLY
_PW = Flag.PARAMETER | Flag.WHOLE
_IDENTITY, _CALIBRATION, _TUNING, _LIMITS = Flag.IDENTITY, Flag.CALIBRATION, Flag.TUNING, Flag.LIMITS
_TEST = Flag.PARAMETER | Flag.VOLATILE


def _by_sector(id: int, short: str, about: str, flags: Flag) -> tuple[Parameter, ...]:
    """Angles of the six Hall edges, from parameter `id` on."""
    return tuple(
        Parameter(id + k, f"{short}_{k + 1}", Unit.RAD, -0.506, 0.506, flags, f"{about} {k + 1}") for k in range(6)
    )


DRIVE_PARAMETERS: tuple[Parameter, ...] = (
    Parameter(101, "n_p", Unit.NONE, 1, 64, _PI | Flag.WHOLE | _IDENTITY, "pole pairs"),
    Parameter(102, "R_s_hat", Unit.OHM, 1e-4, 1e2, _P | _IDENTITY, "stator resistance that the firmware assumes"),
    Parameter(103, "L_s_hat", Unit.H, 1e-6, 1.0, _P | _IDENTITY, "stator inductance that the firmware assumes"),
    Parameter(104, "psi_f_hat", Unit.VS, 1e-5, 10.0, _P | _IDENTITY, "rotor flux linkage that the firmware assumes"),
    Parameter(105, "i_max", Unit.A, 0.0, 200.0, _PI | _LIMITS, "largest current reference"),
    Parameter(106, "omega_m_max", Unit.RAD_PER_S, 0.0, 600.0, _PI | _LIMITS, "largest mechanical speed reference"),
    Parameter(
        107, "alpha_m_max", Unit.RAD_PER_S2, 1.0, 1e5, _P | _LIMITS, "largest ramp of the mechanical speed reference"
    ),
    Parameter(
        108, "observer", Unit.NONE, 0, max(AngleSource), _PW | _TUNING, "angle source of the control (see AngleSource)"
    ),
    Parameter(109, "load_angle_comp", Unit.NONE, 0, 1, _PW | _TUNING, "load-angle compensation (18)-(19): 0 off, 1 on"),
    Parameter(110, "k_p_vt", Unit.PER_S, 0.0, 1e5, _P | _TUNING, "vector tracking: proportional gain k_p of (9)"),
    Parameter(111, "k_i_vt", Unit.NONE, 0.0, 1e9, _P | _TUNING, "vector tracking: integral gain k_i of (9), 1/s²"),
    Parameter(
        112, "tau_max", Unit.S, 0.0, 0.1, _P | _TUNING, "vector tracking: largest tau of the back-EMF filter (6)"
    ),
    Parameter(
        113,
        "omega_on",
        Unit.RAD_PER_S,
        0,
        1e4,
        _P | _TUNING,
        "average speed (electrical) above which correction starts",
    ),
    Parameter(
        114,
        "omega_off",
        Unit.RAD_PER_S,
        0,
        1e4,
        _P | _TUNING,
        "average speed (electrical) below which correction stops",
    ),
    Parameter(115, "k_pc", Unit.RAD_PER_A, -10.0, 10.0, _P | _TUNING, "load angle: proportional gain k_pc of (18)"),
    Parameter(116, "k_ic", Unit.RAD_PER_AS, -1e3, 1e3, _P | _TUNING, "load angle: integral gain k_ic of (18)"),
    Parameter(
        117, "literal_sgn", Unit.NONE, 0, 1, _PW | _TUNING, "1 = sgn() of (9) uses the corrected speed, as printed"
    ),
    Parameter(
        118, "hall_timeout", Unit.S, 1e-3, 10.0, _P | _TUNING, "time without an edge after which omega_h is zero"
    ),
    Parameter(119, "bw_omega_lpf", Unit.HZ, 1.0, 8e3, _P | _TUNING, "cut-off of the filter on the estimated speed"),
    Parameter(120, "bw_current", Unit.HZ, 1.0, 4e3, _P | _TUNING, "bandwidth of the current loop"),
    Parameter(
        121, "k_p_speed", Unit.A_S_PER_RAD, 0.0, 1e3, _P | _TUNING, "speed loop: proportional gain, by mechanical speed"
    ),
    Parameter(122, "k_i_speed", Unit.A_PER_RAD, 0.0, 1e5, _P | _TUNING, "speed loop: integral gain"),
    Parameter(123, "dead_time_hat", Unit.S, 0.0, 1e-5, _P | _CALIBRATION, "dead time that the compensation assumes"),
    Parameter(
        124, "dead_time_comp", Unit.NONE, 0.0, 1.5, _P | _TUNING, "share of the dead-time error that is compensated"
    ),
    Parameter(
        125,
        "watchdog",
        Unit.S,
        0.05,
        1.0,
        _PI | _LIMITS,
        "time without ALIVE or SETPOINT after which the outputs go off",
    ),
    Parameter(
        126,
        "inject",
        Unit.NONE,
        0,
        2,
        _PW | _TUNING,
        "test sine: 0 off, 1 on the angle of theta*, 2 on that of theta_h",
    ),
    Parameter(127, "inject_amplitude", Unit.RAD, 0.0, 0.5, _P | _TUNING, "amplitude of the test sine"),
    Parameter(128, "inject_hz", Unit.HZ, 0.0, 4e3, _P | _TUNING, "frequency of the test sine"),
    Parameter(
        129, "i_range", Unit.A, 0.0, 1e4, _P | Flag.READ_ONLY | _IDENTITY, "full scale of the current sensors, + and -"
    ),
    *_by_sector(
        130, "edge_up", "edge passed forward: ideal minus actual angle, at the start of sector", _P | _CALIBRATION
    ),
    *_by_sector(
        136, "edge_down", "edge passed in reverse: ideal minus actual angle, at the start of sector", _P | _CALIBRATION
    ),
    Parameter(
        142, "J_hat", Unit.KGM2, 1e-8, 10.0, _P | _IDENTITY, "inertia of the whole shaft that the firmware assumes"
    ),
    Parameter(143, "bw_hall_vector", Unit.HZ, 0.0, 1e3, _P | _TUNING, "bandwidth of the observers on the Hall vector"),
    Parameter(
        144,
        "learn_edges",
        Unit.NONE,
        0,
        1,
        _PW | _TUNING,
        "Kalman filter on Hall edges: 0 keep what it learned, 1 learn",
    ),
    Parameter(145, "i_trip", Unit.A, 0.0, 1e3, _P | _LIMITS, "phase current above which the drive trips: OVERCURRENT"),
    Parameter(
        146,
        "omega_m_trip",
        Unit.RAD_PER_S,
        0.0,
        1e4,
        _P | _LIMITS,
        "mechanical speed above which the drive trips: OVERSPEED",
    ),
    Parameter(
        147, "u_dc_min", Unit.V, 0.0, 1e3, _P | _LIMITS, "DC link voltage below which the drive trips: UNDERVOLTAGE"
    ),
    Parameter(
        148, "u_dc_max", Unit.V, 0.0, 1e3, _P | _LIMITS, "DC link voltage above which the drive trips: OVERVOLTAGE"
    ),
    Parameter(149, "dead_time_learn", Unit.NONE, 0, 1, _PW | _TUNING, "1 = learn and compensate what these two leave"),
    Parameter(
        150, "edge_sd", Unit.RAD, 0.0, 0.5, _P | _CALIBRATION, "standard deviation common to all edges of one direction"
    ),
    Parameter(
        151,
        "hall_offset",
        Unit.RAD,
        -math.pi,
        math.pi,
        _PI | _CALIBRATION,
        "ideal angle of the edge at the start of sector 1",
    ),
    Parameter(
        152,
        "hall_swap_hat",
        Unit.NONE,
        0,
        max(HallSwap),
        _PI | Flag.WHOLE | _CALIBRATION,
        "Hall wires exchanged, see HallSwap",
    ),
    Parameter(
        153, "hall_invert_hat", Unit.NONE, 0, 7, _PI | Flag.WHOLE | _CALIBRATION, "Hall inputs inverted, one bit each"
    ),
    Parameter(
        154,
        "encoder_lines",
        Unit.NONE,
        1,
        1e6,
        _PI | Flag.WHOLE | _CALIBRATION,
        "lines of the encoder: counts a turn over 4",
    ),
    Parameter(
        155,
        "encoder_reverse",
        Unit.NONE,
        0,
        1,
        _PI | Flag.WHOLE | _CALIBRATION,
        "1 = the encoder counts down in the positive direction",
    ),
    Parameter(
        156,
        "encoder_zero",
        Unit.RAD,
        -math.pi,
        math.pi,
        _PI | _CALIBRATION,
        "electrical angle at which the encoder's count is 0",
    ),
    Parameter(157, "i_cont", Unit.A, 0.0, 1e3, _P | _LIMITS, "current that the winding bears for ever"),
    Parameter(
        158,
        "i2t_max",
        Unit.A2S,
        0.0,
        1e6,
        _P | _LIMITS,
        "excess of i^2 over i_cont^2, integrated, at which the drive trips: OVERLOAD; 0 = never",
    ),
    Parameter(
        159,
        "u_test_max",
        Unit.V,
        0.0,
        1e3,
        _PI | _LIMITS,
        "largest voltage of VOLTAGE, and largest jump of the voltage",
    ),
    Parameter(
        160,
        "forced",
        Unit.NONE,
        0,
        1,
        _TEST | Flag.WHOLE,
        "1 = the control uses the forced angle, whatever `observer` says",
    ),
    Parameter(161, "forced_speed", Unit.RAD_PER_S, -1e4, 1e4, _TEST, "electrical speed of the forced angle"),
    Parameter(
        162, "forced_angle", Unit.RAD, -math.pi, math.pi, _TEST, "where the forced angle goes while forced_speed is 0"
    ),
    Parameter(163, "forced_slope", Unit.RAD_PER_S2, 1.0, 1e6, _TEST, "ramp of the forced speed"),
    Parameter(
        164,
        "test",
        Unit.NONE,
        0,
        max(TestSignal),
        _TEST | Flag.WHOLE,
        "what the test signal is added to (see TestSignal)",
    ),
    Parameter(165, "test_voltage", Unit.V, 0.0, 1e3, _TEST, "amplitude of the test signal on a voltage"),
    Parameter(166, "test_current", Unit.A, 0.0, 1e3, _TEST, "amplitude of the test signal on a current"),
    Parameter(
        167, "test_speed", Unit.RAD_PER_S, 0.0, 1e3, _TEST, "amplitude of the test signal on the speed, mechanical"
    ),
    Parameter(
        168,
        "test_periods",
        Unit.NONE,
        1,
        65535,
        _TEST | Flag.WHOLE,
        "PWM periods of half a cycle of the square, or of each sample of the waveform",
    ),
    Parameter(
        169,
        "test_length",
        Unit.NONE,
        0,
        65535,
        _TEST | Flag.WHOLE,
        "samples of the waveform (blob 4) that are repeated; 0 = a square",
    ),
)

LOAD_PARAMETERS: tuple[Parameter, ...] = (
    Parameter(101, "tau_max", Unit.NM, 0.0, 100.0, _PI, "largest torque"),
    Parameter(102, "omega_m_max", Unit.RAD_PER_S, 0.0, 600.0, _PI, "largest forced speed"),
    Parameter(103, "watchdog", Unit.S, 0.05, 1.0, _PI, "time without ALIVE or SETPOINT until the torque goes off"),
    Parameter(104, "hall_swap", Unit.NONE, 0, max(HallSwap), _PW, "Hall wires exchanged or rotated (see HallSwap)"),
    Parameter(105, "hall_open", Unit.NONE, 0, 7, _PW, "Hall wires broken, one bit each; the input reads 1"),
    Parameter(106, "hall_glitch", Unit.PER_S, 0.0, 1e5, _P, "false pulses of 2 to 5 us on the Hall wires, mean rate"),
    *_by_sector(107, "hall_delta", "edge: ideal minus actual angle, at the start of sector", _P),
    Parameter(113, "hall_invert", Unit.NONE, 0, 7, _PW, "Hall inputs inverted, one bit each"),
    Parameter(114, "hall_short", Unit.NONE, 0, 7, _PW, "Hall wires shorted, one bit each; the input reads 0"),
    Parameter(115, "faults", Unit.NONE, 0, 1, _PW, "1 = the faults of the rig's own configuration are in force"),
)
