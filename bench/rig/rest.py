"""Whether a drive is at rest before anything is done to it."""

from __future__ import annotations

from bench.device.node import Node
from bench.device.safety import is_off, says
from bench.errors import BenchError, NodeError
from protocol.messages import DriveState


def require_rest(node: Node, target: str, or_fault: bool = False) -> None:
    """Raise BenchError unless `node` says that its outputs are off and, unless `or_fault`, that it has no fault.

    NodeError where it says nothing of them, or names a state that there is not.
    """
    heartbeat = node.next_heartbeat()
    if heartbeat is None:
        raise NodeError(f"{target} sends no heartbeat: the state of its outputs is unknown")
    if heartbeat.state == DriveState.FAULT and not or_fault:
        raise BenchError(
            f"{target} has a latched fault ({node.fault_text()}): find the cause, then clear it "
            "(bench live TARGET --clear-faults --duration 1 --viewer none)"
        )
    if heartbeat.outputs_on or heartbeat.state in (DriveState.ARMED, DriveState.RUNNING):
        raise BenchError(f"{target} is not at rest ({says(heartbeat)}): another host is using it")
    if not is_off(heartbeat):  # a state that no drive has
        raise NodeError(f"{target}: not known whether its outputs are off: {says(heartbeat)}")
