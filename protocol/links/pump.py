"""Reads a port into a pipe, in a process of its own: `python -I -S pump.py PORT`, with the pipe as its output.

What a busy host does not get to read waits in the pipe, where there is more room than in a port. It says READY, and
reads once its input has been closed: until then the host reads the port itself. It ends when the port is gone, or
nobody is there who could read the pipe. It imports little, to be there within some 10 ms.
"""

import os
import select
import sys

READY = b"\0"
_AT_ONCE = 65536  # bytes


def pump(port: int, wait: int, pipe: int) -> None:
    """Move bytes until one end is gone."""
    os.write(pipe, READY)
    os.read(wait, 1)
    ends = select.poll()
    ends.register(port, select.POLLIN)
    ends.register(pipe, 0)  # an error when its other end has been closed
    while all(end != pipe for end, _ in ends.poll()):
        try:
            data = os.read(port, _AT_ONCE)
        except BlockingIOError:  # somebody else took it
            continue
        if not data:
            return
        os.write(pipe, data)


if __name__ == "__main__":
    try:
        pump(int(sys.argv[1]), 0, 1)
    except OSError:
        pass
