"""The device's states, faults and watchdog.

    BOOT -> IDLE -> ARMED -> RUNNING; FAULT from anywhere, latched; STOP from anywhere.

ARMED lapses after 5 s. The watchdog works in ARMED and RUNNING, always. Time is the device's tick, an
argument. This module knows no frames and never touches an output: it tells the `DeviceApp` which state to
enter.
"""

from __future__ import annotations

from collections.abc import Callable

from protocol.device.app import DeviceApp
from protocol.errors import Refused
from protocol.messages import Command, DriveState, ErrorCode, EventCode, Fault

ARM_SECONDS = 5.0
DEFAULT_WATCHDOG_SECONDS = 0.2
WATCHDOG_OFF = 0xFFFF  # in the heartbeat

_LIVE = (DriveState.ARMED, DriveState.RUNNING)


class StateMachine:
    """States of one device. `emit(code, arg)` is called at every change."""

    def __init__(self, app: DeviceApp, boot_id: int, tick_hz: int, emit: Callable[[EventCode, float], None]) -> None:
        self.state = DriveState.BOOT
        self.faults = Fault(0)  # latched since the last FAULT_CLEAR
        self.first_fault = Fault(0)  # what came first
        self._app = app
        self._boot_id = boot_id
        self._tick_hz = tick_hz
        self._emit = emit
        self._has_watchdog = any(parameter.name == "watchdog" for parameter in app.parameters)
        self._fed = 0
        self._armed = 0

    def advance(self, tick: int) -> None:
        """Let time pass: end of BOOT, lapse of ARMED, watchdog."""
        if self.state is DriveState.BOOT:
            self._enter(DriveState.IDLE)
        elif self.state in _LIVE and tick - self._fed >= self._watchdog_ticks():
            self.fault(Fault.WATCHDOG)
        elif self.state is DriveState.ARMED and tick - self._armed >= ARM_SECONDS * self._tick_hz:
            self._emit(EventCode.ARM_LAPSED, ARM_SECONDS)
            self._enter(DriveState.IDLE)

    def feed(self, tick: int) -> None:
        """Feed the watchdog: ALIVE, or a SETPOINT that was accepted."""
        self._fed = tick

    def watchdog_ms(self, tick: int) -> int:
        """Return what is left, 0xFFFF when the watchdog is not at work."""
        if self.state not in _LIVE:
            return WATCHDOG_OFF
        left = self._watchdog_ticks() - (tick - self._fed)
        return max(0, min(WATCHDOG_OFF - 1, int(left * 1000 / self._tick_hz)))

    def fault(self, bits: Fault) -> None:
        """Latch faults and enter FAULT; outputs go off."""
        new = bits & ~self.faults
        if not new:
            return
        if not self.faults:
            self.first_fault = new
        self.faults |= new
        if self.state is not DriveState.FAULT:
            self._enter(DriveState.FAULT)
        self._emit(EventCode.FAULT, float(new))

    def command(self, command: Command, argument: int, tick: int) -> DriveState:
        """Carry out a STATE_CMD and return the state after it; Refused if it is not allowed now. STOP always is."""
        if command is Command.ARM:
            self._arm(argument, tick)
        elif command is Command.START:
            if argument:
                raise Refused(f"START has the argument {argument}", ErrorCode.BAD_VALUE, float(argument))
            if self.state not in _LIVE:
                raise self._wrong_state("START needs ARMED")
            if self.state is DriveState.ARMED:
                self._enter(DriveState.RUNNING)
        elif command is Command.STOP:
            if self.state in _LIVE:
                self._enter(DriveState.IDLE)
        else:
            self._clear(Fault(argument))
        return self.state

    def _arm(self, token: int, tick: int) -> None:
        if token != self._boot_id:
            raise Refused("the token of ARM is not this boot's boot_id", ErrorCode.BAD_TOKEN)
        if self.state not in (DriveState.IDLE, DriveState.ARMED):
            raise self._wrong_state("ARM needs IDLE")
        if self.state is DriveState.IDLE:
            self._enter(DriveState.ARMED)
        self._armed = self._fed = tick

    def _clear(self, faults: Fault) -> None:
        if self.state is not DriveState.FAULT:
            raise self._wrong_state("FAULT_CLEAR needs FAULT")
        if faults != self.faults:
            raise Refused("the faults are others than those named", ErrorCode.FAULTS_CHANGED, float(self.faults))
        persist = self._app.clear_faults(faults)
        if persist:
            raise Refused("the cause is still there", ErrorCode.FAULT_PERSISTS, float(persist))
        self.faults = self.first_fault = Fault(0)
        self._enter(DriveState.IDLE)

    def _enter(self, state: DriveState) -> None:
        self._app.enter_state(state)
        self.state = state
        self._emit(EventCode.STATE_CHANGED, float(state))

    def _wrong_state(self, text: str) -> Refused:
        return Refused(f"{text}, the state is {self.state.name}", ErrorCode.WRONG_STATE, float(self.state))

    def _watchdog_ticks(self) -> int:
        seconds = self._app.get_param("watchdog") if self._has_watchdog else DEFAULT_WATCHDOG_SECONDS
        return round(seconds * self._tick_hz)
