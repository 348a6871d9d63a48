"""The standard streams: what a terminal cannot show, a reader that goes away and a full device are dealt with here.

Whatever is printed, by this program or by a library, passes `standard_streams`. The text of one line passes `echo` or
`note`, which keep control characters from the terminal.
"""

from __future__ import annotations

import codecs
import errno
import io
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO, cast

from bench.errors import BenchError, ExitCode
from protocol.text import printable

_PLAIN = {
    "Ω": "Ohm", "µ": "u", "°": "deg", "²": "^2", "³": "^3", "·": "*", "×": "x", "±": "+-", "…": "...", "–": "-",
    "—": "-", "−": "-", "≤": "<=", "≥": ">=", "∞": "inf", "’": "'",
}  # fmt: skip
"""What is shown instead where the terminal's encoding lacks a character; all others are escaped."""


class OutputError(BenchError):
    """Standard output cannot be written."""


class OutputClosed(BenchError):
    """Nobody reads standard output any more; the exit code is that of SIGPIPE."""

    exit_code = ExitCode.NO_READER


def echo(text: str = "") -> None:
    """Print lines on standard output; control characters in them are shown as escapes."""
    print(lines(text), flush=True)


def note(text: str) -> None:
    """Print lines on standard error, likewise."""
    print(lines(text), file=sys.stderr, flush=True)


def lines(text: str) -> str:
    """The text with escapes in place of control characters, all but the ends of lines."""
    return "\n".join(map(printable, text.split("\n")))


@contextmanager
def standard_streams() -> Iterator[None]:
    """Meanwhile standard output raises OutputClosed and OutputError, and what standard error cannot take is lost.

    Neither raises for a character that its encoding lacks. Streams that were closed from the start are opened: input to
    nothing, output to a pipe without a reader, errors to nothing.
    """
    _open_closed()
    before = sys.stdout, sys.stderr
    sys.stdout = cast(TextIO, _Guarded(before[0], _raise))
    sys.stderr = cast(TextIO, _Guarded(before[1], lambda error: None))
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


class _Guarded:
    """A stream that calls `failed` where writing fails. What it still holds then is dropped."""

    def __init__(self, stream: Any, failed: Callable[[OSError], None]) -> None:
        self._stream = stream
        self._failed = failed

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    @property
    def buffer(self) -> _Guarded:
        """The same for bytes."""
        return _Guarded(self._stream.buffer, self._failed)

    def write(self, data: Any) -> int:
        """Write text or bytes. Writing nothing is a probe for the kind of stream, which a full device may refuse."""
        if not data:
            with suppress(OSError):
                self._stream.write(data)
            return 0
        if isinstance(data, str):
            encoding = self._stream.encoding or "utf-8"
            data = data.encode(encoding, _ERRORS).decode(encoding)
        self._attempt(lambda: self._stream.write(data))
        return len(data)

    def writelines(self, lines: Any) -> None:
        """Write all of them."""
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """Hand on what was written."""
        self._attempt(self._stream.flush)

    def _attempt(self, action: Callable[[], object]) -> None:
        try:
            action()
        except OSError as error:
            with suppress(OSError, io.UnsupportedOperation):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, self._stream.fileno())
                os.close(nowhere)
            self._failed(error)


def _raise(error: OSError) -> None:
    if isinstance(error, BrokenPipeError) or (sys.platform == "win32" and error.errno == errno.EINVAL):
        raise OutputClosed("standard output was closed") from None
    raise OutputError(f"standard output cannot be written: {error.strerror}") from None


def _open_closed() -> None:
    if sys.stdin is None:
        sys.stdin = open(os.devnull, encoding="utf-8")  # noqa: SIM115
    if sys.stdout is None:
        reader, writer = os.pipe()
        if writer != 1:
            os.dup2(writer, 1)
            os.close(writer)
        if reader != 1:
            os.close(reader)
        sys.stdout = open(1, "w", encoding="utf-8")  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115


def _shown(error: UnicodeError) -> tuple[str, int]:
    assert isinstance(error, UnicodeEncodeError)
    text = error.object[error.start : error.end]
    return "".join(_PLAIN.get(c) or _braille(c) or c.encode("unicode_escape").decode() for c in text), error.end


def _braille(character: str) -> str:
    """The dots of a status line's spinner."""
    return "*" if "\u2800" <= character <= "\u28ff" else ""


_ERRORS = "hallbench"
codecs.register_error(_ERRORS, _shown)
