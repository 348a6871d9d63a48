"""Bytes and text of a file that may be packed with gzip, and errors of libraries in one line of ours."""

from __future__ import annotations

import gzip
import io
import logging
import sys
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import IO, Any, cast

from bench.errors import BenchError, RecordingError
from protocol.text import printable

MOST_WORDS, MOST_LOGGED = 5, 2000
"""Of a library about one file."""
HEAD = 1 << 18
"""Bytes from which it is told how a text is written."""


def stream(path: Path) -> IO[bytes]:
    """The file's bytes, unpacked. Raises OSError."""
    return cast("IO[bytes]", gzip.open(path) if path.suffix == ".gz" else path.open("rb"))


def head(path: Path, size: int = HEAD) -> bytes:
    """Its first bytes. Raises BenchError."""
    with reading(path), stream(path) as file:
        return file.read(size)


@contextmanager
def reading(path: Path, what: str = "", *further: type[Exception]) -> Iterator[None]:
    """Errors of the file system, of gzip and of a library, `further`, as a BenchError about this file."""
    try:
        yield
    except BenchError:
        raise
    except MemoryError:
        raise BenchError(f"{path}: it does not fit into memory") from None
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise BenchError(f"{path}: it is damaged, or cut short: {_line(error)}") from None
    except OSError as error:
        if what and error.errno is None:  # of a library
            raise BenchError(f"{path} is no {what} that can be read: {_line(error)}") from None
        raise BenchError(f"{path} cannot be read: {error.strerror or _line(error)}") from None
    except further as error:
        raise BenchError(f"{path} is no {what} that can be read: {_line(error)}") from None


@contextmanager
def told_by(library: str, into: list[str]) -> Iterator[None]:
    """What a library logs of a file goes to `into`, not to the terminal; nor does what it throws away half made.

    Of one that does not come to an end with logging, a ValueError is raised.
    """
    sink = _Sink()
    _throw_away_quietly(library)
    named = [
        logging.getLogger(name) for name in [library, *logging.Logger.manager.loggerDict] if name.startswith(library)
    ]
    for logger in named:
        logger.handlers, logger.propagate = [sink], False
    try:
        with redirect_stdout(io.StringIO()):
            yield
    finally:
        into += [f"{library}: {words}" for words in dict.fromkeys(sink.words)][:MOST_WORDS]
        sink.words.clear()


def _throw_away_quietly(library: str) -> None:
    """From now on: what a library has half made may be thrown away at any time later."""
    hook = sys.unraisablehook
    libraries: set[str] | None = getattr(hook, "libraries", None)
    if libraries is not None:
        libraries.add(library)
        return

    def quiet(told: Any) -> None:
        if not (getattr(told.object, "__module__", None) or "").startswith(tuple(quiet.libraries)):  # type: ignore[attr-defined]
            hook(told)

    quiet.libraries = {library}  # type: ignore[attr-defined]
    sys.unraisablehook = quiet


class _Sink(logging.Handler):
    """Keeps what is logged."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.words: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler`."""
        if len(self.words) >= MOST_LOGGED:  # it may go on for ever
            raise ValueError(self.words[-1])
        self.words.append(printable(record.getMessage())[:120])


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Errors that do not say which file they are about say so."""
    try:
        yield
    except RecordingError:
        raise
    except BenchError as error:
        if path.name in str(error):
            raise
        raise BenchError(f"{path}: {error}") from None


def _line(error: Exception) -> str:
    text = printable(str(error).strip().split("\n")[0])[:200]
    return text or type(error).__name__


def encoding_of(data: bytes) -> str:
    """How a text is encoded: by its byte-order mark, UTF-8 if that fits, else Latin-1."""
    for mark, name in ((b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"), (b"\xef\xbb\xbf", "utf-8-sig")):
        if data.startswith(mark):
            return name
    try:
        data[: len(data) - 4].decode("utf-8")
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8"


class Utf8(io.RawIOBase):
    """A text in another encoding, or with several spaces between its columns, as plain UTF-8."""

    def __init__(self, file: IO[bytes], encoding: str, squeeze: bool) -> None:
        self._text = io.TextIOWrapper(cast("Any", file), encoding=encoding, errors="replace", newline="")
        self._squeeze, self._rest = squeeze, b""

    def readable(self) -> bool:
        """Yes."""
        return True

    def readinto(self, buffer: Any) -> int:
        """See `io.RawIOBase`."""
        while not self._rest:
            text = self._text.read(1 << 16)
            if not text:
                return 0
            if self._squeeze:
                text += self._text.readline()
                text = "\n".join(" ".join(line.split()) for line in text.splitlines()) + "\n"
            self._rest = text.encode("utf-8", "replace")
        n = min(len(buffer), len(self._rest))
        buffer[:n], self._rest = self._rest[:n], self._rest[n:]
        return n

    def skip_lines(self, n: int) -> None:
        """Leave out lines at the beginning."""
        for _ in range(n):
            self._text.readline()
