"""Faults that the application of a C device finds in a place where it is being asked something."""

from __future__ import annotations

import pytest

from protocol.device.compiled import CompiledLink, CompiledSession
from protocol.messages import Command, DriveState, Fault, StateCommand
from tests.protocol.small_drive import SmallDrive, frames_in, identity, wire_of
from tests.tools import needs

BOOT = 0xB0071D
pytestmark = needs("C compiler")


class Failing(SmallDrive):
    """Finds a fault when it is to enter a state."""

    session: CompiledSession

    def __init__(self, at: DriveState) -> None:
        super().__init__()
        self._at = at

    def enter_state(self, state: DriveState) -> None:
        super().enter_state(state)
        if state is self._at:
            self.session.fault(Fault.UNDERVOLTAGE)


@pytest.mark.parametrize("at", [DriveState.IDLE, DriveState.ARMED, DriveState.RUNNING])
def test_a_fault_found_while_a_state_is_entered_stays(at: DriveState) -> None:
    link, app = CompiledLink(), Failing(at)
    app.session = session = link.add(app, identity())
    link.advance(0)
    link.data_to_send()
    link.receive(wire_of(StateCommand(Command.ARM, BOOT), 1) + wire_of(StateCommand(Command.START, 0), 2))
    assert session.state is DriveState.FAULT
    assert session.faults == Fault.UNDERVOLTAGE
    assert not app.outputs_on
    replies = [frame for frame in frames_in(link.data_to_send()) if frame.is_reply]
    assert [frame.is_error for frame in replies] == [at is not DriveState.RUNNING, True]
