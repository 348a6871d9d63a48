"""What the drive held at a fault of a run, unasked: fetched when the outputs are off, and kept beside the recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bench.capture.memory import COMPLETE, CaptureMemory, held_words
from bench.device.node import Node
from bench.errors import BenchError
from bench.files import is_run, run_folder
from bench.record.folder import remove
from bench.record.layout import fault_run
from bench.rig.capturing import Capturing
from bench.rig.screen import Screen
from bench.rig.settings import Settings
from protocol.errors import HbpError
from protocol.messages import CaptureReply, CaptureState, CaptureTrigger

LONGEST = 20.0  # s that the end of a run waits for what the drive held: a quarter of a second at 115200 baud, and some


class AtFault:
    """Of one run of a drive that has the feature CAPTURE; of any other it does nothing.

    `save`: the recording, beside which it is kept; None: it is left in the drive, and told if that `lasts`.
    """

    def __init__(
        self, node: Node, target: str, settings: Settings, screen: Screen, save: Path | None, lasts: bool
    ) -> None:
        self._node, self._screen, self._lasts = node, screen, lasts
        self._path = None if save is None else fault_run(run_folder(save))
        self._capturing = Capturing(node, target, settings, screen) if node.offers_capture else None
        self._before: tuple[int, int] | None = None  # boot and number of what it held when the run began

    def look(self) -> None:
        """Before the run: tell what the drive still holds, and remove what an earlier run of this name has kept."""
        if self._path is not None and is_run(self._path):
            remove(self._path)
        if self._capturing is None:
            return
        held = self._capturing.memory.status()
        if held.state == CaptureState.FROZEN:
            self._before = self._node.identity.boot_id, held.number
            words = f"{held_words(self._node, held)}, and takes no other one until then"
            self._screen.note(f"{words}: {self._capturing.advice}")

    def keep(self) -> dict[str, Any]:
        """After the run: what the drive has held since a fault of it, as plain data; empty where it holds nothing.

        Raises nothing of the link: what cannot be read is told, and stays in the drive.
        """
        if self._capturing is None:
            return {}
        try:
            held = self._frozen(self._capturing.memory)
            if held is not None and self._path is not None:
                return self._capturing.fetch(self._path, overwrite=True, most=LONGEST).as_json()
            if held is not None and self._lasts:
                self._screen.note(f"{held_words(self._node, held)}: {self._capturing.advice}")
        except (BenchError, HbpError) as error:
            self._screen.note(f"what the drive held at the fault was not kept: {error}")
        return {}

    def _frozen(self, memory: CaptureMemory) -> CaptureReply | None:
        """What a fault of this run has frozen; a moment is waited for that."""
        now = memory.status()
        if now.trigger != CaptureTrigger.FAULT or self._before == (self._node.identity.boot_id, now.number):
            return None
        if now.state == CaptureState.TRIGGERED:
            return memory.wait(now.number, COMPLETE)
        return now if now.state == CaptureState.FROZEN else None
