"""The two devices of the simulated bench as their sessions see them: the drive and the load machine.

Each checks what the host asks against its limits and passes it on to the `SimulatedBench`; neither knows frames or
time.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from protocol.errors import Refused
from protocol.messages import DriveState, ErrorCode, Fault, SetpointMode
from protocol.signals import (
    DRIVE_PARAMETERS,
    LOAD_CHANNELS,
    LOAD_PARAMETERS,
    MILLI,
    AngleSource,
    Flag,
    Parameter,
    Signal,
)
from sim.config.params import ConfigError
from sim.drive.channels import SOURCES, channels
from sim.drive.machine import SimulatedBench

AT_A_FAULT = frozenset(
    "hall status theta_enc omega_enc i_a i_b i_c u_alpha u_beta u_dc i_d i_q i_d_ref i_q_ref omega_ref "  # noqa: SIM905
    "theta_avg omega_avg theta_vt omega_vt theta_ctrl".split()
)
"""Channels of the capture that waits for a fault: what is measured and controlled, and estimated in any case."""
SLACK = 1.05  # of `u_test_max`, of which a voltage may be away: a loop's is never still; the firmware is strict
LIMITED = {
    "forced_speed": ("electrical speed", ("n_p", "omega_m_max")),
    "test_voltage": ("voltage", ("u_test_max",)),
    "test_current": ("current", ("i_max",)),
    "test_speed": ("speed", ("omega_m_max",)),
}
"""Parameters of commissioning that others limit: what they are, and the others, whose product is the limit."""


class DriveApp:
    """The drive (a `protocol.device.app.DeviceApp`).

    Args:
        store: file that keeps the parameters over a boot; they are read from it now and written by `commit`.

    Raises:
        ConfigError: the store holds something else than this drive's parameters.
    """

    def __init__(self, bench: SimulatedBench, store: Path | None = None) -> None:
        self._bench = bench
        self._defaults = dict(bench.parameters)
        self._store = store
        encoder = bool(bench.params.encoder.present)
        self.channels = channels(bench.params)
        """See `DeviceApp`."""
        sources = float(AngleSource.ENCODER if encoder else AngleSource.AVERAGE_SPEED), float(max(SOURCES))
        self.waveform = bench.waveform
        """See `protocol.device.app.Extras`."""
        ranges = {"observer": sources, "test_length": (0.0, float(len(self.waveform)))}
        self.parameters = tuple(
            replace(p, lo=ranges[p.name][0], hi=ranges[p.name][1]) if p.name in ranges else p
            for p in DRIVE_PARAMETERS
            if encoder or not p.name.startswith("encoder_")
        )
        """See `DeviceApp`."""
        self.meanings = _meanings(self.channels, self.parameters)
        """See `protocol.device.app.Extras`."""
        self.fault_channels = tuple(channel.name for channel in self.channels if channel.name in AT_A_FAULT)
        """See `protocol.device.app.Extras`."""
        if store is not None:
            for name, value in _read_store(store, self.parameters).items():
                bench.set_param(name, value)

    @property
    def outputs_on(self) -> bool:
        """See `DeviceApp`."""
        return self._bench.outputs_on

    def enter_state(self, state: DriveState) -> None:
        """See `DeviceApp`."""
        self._bench.enter_state(state)

    def clear_faults(self, faults: Fault) -> Fault:
        """See `DeviceApp`."""
        persisting = self._bench.fault_causes & faults
        if not persisting:
            self._bench.clear_faults()
        return persisting

    def setpoint(self, mode: SetpointMode, value: float, value2: float) -> None:
        """SPEED (mechanical rad/s) up to `omega_m_max`, with i_d (A); CURRENT (i_q, i_d in A) up to `i_max` together.

        VOLTAGE (u_q, u_d in V) up to `u_test_max`, which it may not be further away from the present voltage either.
        """
        if mode is SetpointMode.SPEED:
            if self.get_param("forced"):
                raise Refused("SPEED needs a speed that is measured: forced is 1", ErrorCode.NOT_SUPPORTED, mode)
            _limit("speed", abs(value), self.get_param("omega_m_max"))
            _limit("d current", abs(value2), self.get_param("i_max"))
        elif mode is SetpointMode.VOLTAGE:
            if not self._knows_angle({}):
                text = "VOLTAGE needs the forced angle or the encoder's: set forced to 1, or observer to 0"
                raise Refused(text, ErrorCode.NOT_SUPPORTED, mode)
            most = self.get_param("u_test_max")
            _limit("voltage", math.hypot(value, value2), most)
            jump = abs(complex(value2, value) - self._bench.voltage)
            if jump > SLACK * most + 2.0 * MILLI:
                raise Refused(f"the voltage would jump by {jump:.3g} V, above {most:g}", ErrorCode.OUT_OF_RANGE, most)
        elif mode is SetpointMode.CURRENT:
            _limit("current", math.hypot(value, value2), self.get_param("i_max"))
        else:
            raise Refused(f"a drive has no setpoint {mode.name}", ErrorCode.NOT_SUPPORTED, mode)
        self._bench.setpoint(mode, value, value2)

    def get_param(self, name: str) -> float:
        """See `DeviceApp`."""
        return self._bench.parameters[name]

    def default_param(self, name: str) -> float:
        """See `DeviceApp`."""
        return self._defaults[name]

    def set_param(self, name: str, value: float) -> None:
        """See `DeviceApp`."""
        self._check(name, value)
        self._bench.set_param(name, value)

    def _check(self, name: str, value: float) -> None:
        """Refuse what a parameter of commissioning cannot be now."""
        if name in LIMITED:
            of, limits = LIMITED[name]
            _limit(of, abs(value), math.prod(self.get_param(limit) for limit in limits))
        elif name == "test" and value and self.get_param("test"):
            raise Refused("another test signal is on: set test to 0 first", ErrorCode.BUSY, value)
        elif name == "forced" and value and self._bench.mode == SetpointMode.SPEED:
            raise self._in_use("SPEED needs a speed that is measured")
        elif self._bench.mode == SetpointMode.VOLTAGE and not self._knows_angle({name: value}):
            raise self._in_use("VOLTAGE needs the forced angle or the encoder's")

    def _knows_angle(self, changed: dict[str, float]) -> bool:
        """Whether the control's angle is forced or the encoder's, with these parameters changed."""
        values = self._bench.parameters | changed
        return bool(values["forced"]) or values["observer"] == AngleSource.ENCODER

    def _in_use(self, why: str) -> Refused:
        return Refused(f"{why}, and is in use: give another setpoint first", ErrorCode.WRONG_STATE, DriveState.RUNNING)

    def commit(self) -> None:
        """Write the store, whole or not at all."""
        if self._store is None:
            raise Refused("this drive has no store", ErrorCode.NOT_SUPPORTED)
        new = self._store.with_name(self._store.name + ".new")
        try:
            settable = {p.name for p in self.parameters if not p.flags & (Flag.READ_ONLY | Flag.VOLATILE)}
            values = {name: value for name, value in self._bench.parameters.items() if name in settable}
            new.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
            os.replace(new, self._store)
        except OSError as error:
            raise Refused(f"cannot write {self._store}: {error.strerror}", ErrorCode.STORE_FAILED) from None


class LoadApp:
    """The load machine on the drive's shaft (a `protocol.device.app.DeviceApp`)."""

    channels = LOAD_CHANNELS
    """See `DeviceApp`."""
    parameters = LOAD_PARAMETERS
    """See `DeviceApp`."""

    def __init__(self, bench: SimulatedBench) -> None:
        self._bench = bench
        self.meanings = _meanings(self.channels, self.parameters)
        """See `protocol.device.app.Extras`."""
        self._defaults = dict(bench.load_parameters)
        self.outputs_on = False
        """See `DeviceApp`."""

    def enter_state(self, state: DriveState) -> None:
        """See `DeviceApp`."""
        self.outputs_on = state is DriveState.RUNNING
        self._bench.load_enter_state(state)

    def clear_faults(self, faults: Fault) -> Fault:
        """See `DeviceApp`."""
        return Fault(0)

    def setpoint(self, mode: SetpointMode, value: float, value2: float) -> None:
        """TORQUE (N·m against the positive direction) up to `tau_max`, SPEED (forced, mechanical rad/s)."""
        if mode is SetpointMode.TORQUE:
            _limit("torque", abs(value), self.get_param("tau_max"))
        elif mode is SetpointMode.SPEED:
            _limit("speed", abs(value), self.get_param("omega_m_max"))
        else:
            raise Refused(f"a load machine has no setpoint {mode.name}", ErrorCode.NOT_SUPPORTED, mode)
        self._bench.load_setpoint(mode, value)

    def get_param(self, name: str) -> float:
        """See `DeviceApp`."""
        return self._bench.load_parameters[name]

    def default_param(self, name: str) -> float:
        """See `DeviceApp`."""
        return self._defaults[name]

    def set_param(self, name: str, value: float) -> None:
        """See `DeviceApp`."""
        try:
            self._bench.set_load_param(name, value)
        except ConfigError as error:
            raise Refused(str(error), ErrorCode.OUT_OF_RANGE, value) from None

    def commit(self) -> None:
        """Refused: the load machine keeps nothing."""
        raise Refused("the load machine has no store", ErrorCode.NOT_SUPPORTED)


def _meanings(channels: Sequence[Signal], parameters: Sequence[Parameter]) -> dict[str, str]:
    """What these are, by name."""
    return {channel.name: channel.about for channel in channels} | {each.name: each.about for each in parameters}


def _limit(what: str, size: float, limit: float) -> None:
    if size > limit:
        raise Refused(f"{what} {size:g} is above {limit:g}", ErrorCode.OUT_OF_RANGE, limit)


def _read_store(path: Path, parameters: Sequence[Parameter]) -> dict[str, float]:
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot read the parameters in {path}: {error}; remove the file") from None
    known = {p.name: p for p in parameters if not p.flags & (Flag.READ_ONLY | Flag.VOLATILE)}
    if not isinstance(stored, dict):
        raise ConfigError(f"{path} holds no parameters; remove the file")
    for name, value in stored.items():
        if name not in known:
            raise ConfigError(f"unknown parameter {name} in {path}; remove the file")
        lo, hi = float(np.float32(known[name].lo)), float(np.float32(known[name].hi))  # as PARAM_SET does
        if isinstance(value, bool) or not isinstance(value, int | float) or not lo <= value <= hi:
            raise ConfigError(f"{name} must be between {lo:g} and {hi:g}, got {value!r} in {path}")
        if known[name].flags & Flag.WHOLE and value != round(value):
            raise ConfigError(f"{name} must be a whole number, got {value!r} in {path}")
    return stored
