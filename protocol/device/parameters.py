"""The device's parameters: what may be set to what, and when; every change is told."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from protocol.device.app import DeviceApp
from protocol.errors import Refused
from protocol.messages import DriveState, ErrorCode, EventCode, ParamGet, ParamReply, ParamSet, ParamStored
from protocol.signals import Flag, Parameter

TEST = "test"
"""The parameter that is not 0 while a test signal is on."""


class ParameterTable:
    """The parameters of one device. `emit(code, arg, detail)` is called at every change."""

    def __init__(self, app: DeviceApp, emit: Callable[[EventCode, float, float], None]) -> None:
        self._app = app
        self._emit = emit
        self._by_id = {parameter.id: parameter for parameter in app.parameters}
        self._has_test = any(parameter.name == TEST for parameter in app.parameters)

    @property
    def testing(self) -> bool:
        """Whether a test signal is on."""
        return self._has_test and self._app.get_param(TEST) != 0

    def get(self, request: ParamGet) -> ParamReply:
        """Carry out PARAM_GET."""
        parameter = self._parameter(request.id)
        value, default = self._app.get_param(parameter.name), self._app.default_param(parameter.name)
        return ParamReply(request.id, value, parameter.lo, parameter.hi, default)

    def set(self, request: ParamSet, state: DriveState) -> ParamStored:
        """Carry out PARAM_SET; Refused, nothing changed, if the value or the moment is wrong."""
        parameter, value = self._parameter(request.id), request.value
        lo, hi = float(np.float32(parameter.lo)), float(np.float32(parameter.hi))
        if parameter.flags & Flag.READ_ONLY:
            raise Refused(f"{parameter.name} is read-only", ErrorCode.READ_ONLY, request.id)
        if not math.isfinite(value) or (parameter.flags & Flag.WHOLE and value != round(value)):
            raise Refused(f"{parameter.name} = {value}", ErrorCode.BAD_VALUE, value)
        if not lo <= value <= hi:
            raise Refused(f"{parameter.name} = {value}", ErrorCode.OUT_OF_RANGE, lo if value < lo else hi)
        if parameter.flags & Flag.IDLE_ONLY and self._app.outputs_on:
            raise Refused(f"{parameter.name} with outputs on", ErrorCode.WRONG_STATE, state)
        return ParamStored(request.id, self._set(parameter, value))

    def reset_volatile(self) -> None:
        """RUNNING has ended: what is VOLATILE is at its default again."""
        for parameter in self._by_id.values():
            if parameter.flags & Flag.VOLATILE:
                default = self._app.default_param(parameter.name)
                if self._app.get_param(parameter.name) != default:
                    self._set(parameter, default)

    def _set(self, parameter: Parameter, value: float) -> float:
        """Set a value, tell it if it has changed, and return what is in use."""
        before = self._app.get_param(parameter.name)
        self._app.set_param(parameter.name, value)
        now = self._app.get_param(parameter.name)
        if now != before:
            self._emit(EventCode.PARAM_CHANGED, float(parameter.id), now)
        return now

    def _parameter(self, number: int) -> Parameter:
        parameter = self._by_id.get(number)
        if parameter is None:
            raise Refused(f"no parameter {number}", ErrorCode.UNKNOWN_ID, number)
        return parameter
