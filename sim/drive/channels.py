"""The channels of the simulated drive, on scales that its configuration needs.

They are those of the protocol's table, and angle and speed of observers that are not in it. A scale is the table's, or
twice it as often as it takes until the largest value fits, so that the paper's drive has the table's.
"""

from __future__ import annotations

import math
from dataclasses import replace

from protocol.signals import DRIVE_CHANNELS, MILLI, AngleSource, RawType, Signal, Unit, estimate_channels
from sim.config.params import BenchParams
from sim.observers.average_speed import FASTEST
from sim.observers.catalogue import CATALOGUE

SOURCES = dict(enumerate(CATALOGUE.values(), 1))
"""The observers by the value of the parameter `observer` that chooses them; 0 is the encoder."""
FURTHER = 0x400  # ids of channels that are not in the protocol's table, from here on
ENCODER_CHANNELS = ("theta_enc", "omega_enc")  # what a drive without an encoder does not have
CHANNELS = (
    *DRIVE_CHANNELS,
    *(
        signal
        for source, entry in SOURCES.items()
        if source > max(AngleSource)
        for signal in estimate_channels(FURTHER + 2 * source, entry.short, entry.source)
    ),
)


def channels(params: BenchParams) -> tuple[Signal, ...]:
    """The channels of a drive with this configuration."""
    motor, firmware = params.motor, params.firmware
    fastest = max(firmware.protection.omega_m_trip, FASTEST * firmware.omega_m_max)
    torque = max(params.load.tau_max, 1.5 * motor.n_p * motor.psi_f * params.current_sensor.range)
    largest = {
        Unit.A: params.current_sensor.range,
        Unit.RAD_PER_S: max(motor.n_p, firmware.n_p) * fastest,
        Unit.NM: torque,
    }
    return tuple(
        replace(c, scale=_scale(c.scale, largest[c.unit])) if c.unit in largest and c.raw is RawType.I16 else c
        for c in CHANNELS
        if params.encoder.present or c.name not in ENCODER_CHANNELS
    )


def ampere(params: BenchParams) -> float:
    """A a count of the current channels."""
    return _scale(MILLI, params.current_sensor.range)


def _scale(scale: float, largest: float) -> float:
    return scale * 2.0 ** max(0, math.ceil(math.log2(largest / (32768 * scale))))
