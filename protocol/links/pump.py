"""Reads a port into a pipe, in a process of its own: `python -I -S pump.py PORT`, with the pipe as its output.

What a busy host does not get to read waits in the pipe, where there is more room than in a port. It says READY, and
reads once its input has been closed: until then the host reads the port itself. It ends when the port is gone, or
nobody is there who could read the pipe. It imports little, to be there within some 10 ms.
"""

import os
import select
import sys

READY = b"\0"
_AT_ONCE = 16384  # bytes

if sys.platform != "win32":  # where nothing starts it

    def pump(port: int, wait: int, pipe: int) -> None:
        """Move bytes until one end is gone."""
        os.write(pipe, READY)
        os.read(wait, 1)
        ends = select.poll()
        ends.register(port, select.POLLIN)
        ends.register(pipe, 0)  # an error when its other end has been closed
        held = bytearray(_AT_ONCE)
        there = memoryview(held)
        while pipe not in dict(ends.poll()):
            try:
                n = os.readv(port, (held,))
            except BlockingIOError:  # somebody else took it
                continue
            if not n:
                return
            os.write(pipe, there[:n])

    if __name__ == "__main__":
        pump(int(sys.argv[1]), 0, 1)  # what it raises, nobody reads: it has ended
