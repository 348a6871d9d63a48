"""What can wait, done by a thread of its own, in order: so that a journal never waits for columns or for the disk."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable

_Done = queue.SimpleQueue[None]
MOST = 50  # that wait; then whoever adds to them does


class Later:
    """Does what it is given. Once something fails, every call raises that, and what waits is left out."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[Callable[[], object] | _Done | None] = queue.SimpleQueue()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._work, name="columns", daemon=True)
        self._thread.start()

    def do(self, work: Callable[[], object]) -> None:
        """Have `work` done."""
        if self._error is not None:
            raise self._error
        if self._queue.qsize() >= MOST:
            self.wait()
        self._queue.put(work)

    def wait(self) -> None:
        """Until all has been done."""
        done: _Done = queue.SimpleQueue()
        self._queue.put(done)
        done.get()
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """End the thread, when all has been done. Nothing may be asked of it after that."""
        self._queue.put(None)

    def _work(self) -> None:
        while (work := self._queue.get()) is not None:
            if isinstance(work, queue.SimpleQueue):
                work.put(None)
            elif self._error is None:
                try:
                    work()
                except Exception as error:
                    self._error = error
