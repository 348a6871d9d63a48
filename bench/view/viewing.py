"""A recorded run in rerun: the dashboard that it had live, of any part of it.

A short part is shown sample by sample. A long one is shown as minima and maxima, which the run has ready, and sample by
sample only around faults, marks and the end: rerun's memory holds minutes of samples, not hours.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import numpy as np
import pyarrow as pa
import rerun as rr

from bench.device.heard import Chunk, Heard, Note
from bench.device.losses import Continuity, LossAccount
from bench.errors import RecordingError
from bench.files import part_of
from bench.record.info import RunInfo, ns_from_tick
from bench.record.layout import EDGES, SAMPLES, numbers
from bench.record.overview import BIN, coarser
from bench.record.reader import Run, Segment, overviews
from bench.signal.chunks import BEGIN, END, between
from bench.view import dashboard, schema, shot
from bench.view.blocks import Block, lost_components
from bench.view.log import RunLog
from bench.view.plots import POINTS, WAVE, plots
from bench.view.shifted import Shifted
from bench.view.sinks import abandon, new_stream
from protocol.host import DeviceEventReceived
from protocol.messages import EventCode

WINDOW = 0.05  # s that go to rerun in one piece; of slow samples as many as there are of fast ones
LOT = 0.25  # s of signal a message; with longer ones a file is half as large again
LOT_BROWSER = 2.0  # the same for a browser: without a GPU it draws a frame in seconds, and reads few messages a frame
CLOSE, MOST_SAMPLES = 60.0, 60_000  # s, or samples if they are no more, that are shown one by one
AROUND = 0.5  # s before and after a fault or a mark that are, in a longer run
MOST_CLOSE = 30  # of those
BINS = 36_000  # that a long run is shown as, at most: half an hour of 50 ms
LOOK, LOOKED_BACK, ENOUGH = 3, 45, 12  # s, s, sectors: from what the length of a sector is found
FLUSH_TIMEOUT = 60.0  # s

Span = tuple[int, int]


def lot_for(kind: str) -> float:
    """`lot` of a file for a `native` viewer, or for a browser (`web`)."""
    return LOT_BROWSER if kind == "web" else LOT


def write_rrd(run: Run, path: Path, first: int = BEGIN, last: int = END, page: int = 0, lot: float = LOT) -> None:
    """Write the part of a run from tick `first` to `last` for rerun's viewer, opened at a page of the dashboard.

    `lot`: s of signal a message; long ones make a larger file.

    Raises RecordingError.
    The file appears, or replaces an earlier one, when it is whole.
    """
    near = closeups(run, first, last, and_end=True)
    if run.info.trigger_tick is not None and run.segments:
        _write_shot(run, path, max(first, run.span[0]), min(last, run.span[1]), near, lot)
        return
    with rrd_file(path, run.info) as stream:
        whole = (max(first, run.span[0]), min(last, run.span[1])) if run.segments else None
        sector = None if whole is None else sector_time(run, *whole)
        shown = run.info, run.marks, whole, close_time(run), near is not None, sector
        # a viewer that reads along needs a layout now; how far the plots reach is known when all has been read
        stream.send_blueprint(dashboard.blueprint(*shown, page=page))
        log = RunLog(stream, run.info, lot)
        log.start()
        show(run, log, first, last, near)
        log.finish()
        assert log.extents is not None
        found = {key: log.extents.of(plot) for key, plot in plots(run.info).items() if plot.entity == schema.TREND}
        extents = {key: extent for key, extent in found.items() if extent is not None}
        stream.send_blueprint(dashboard.blueprint(*shown, extents, page))


def _write_shot(run: Run, path: Path, first: int, last: int, near: list[Span] | None, lot: float) -> None:
    """A capture, at whose trigger time is 0."""
    assert run.info.trigger_tick is not None
    zero, *ends = (int(ns_from_tick(tick, run.info.tick_hz)) for tick in (run.info.trigger_tick, first, last))
    with rrd_file(path, run.info) as stream:
        stream.send_blueprint(shot.blueprint(run.info, *((end - zero) / 1e9 for end in ends)))
        log = RunLog(cast(rr.RecordingStream, Shifted(stream, "", zero)), run.info, lot)
        log.start()
        show(run, log, first, last, near)
        log.finish()


@contextmanager
def rrd_file(path: Path, info: RunInfo) -> Iterator[rr.RecordingStream]:
    """A rerun stream of the run `info` to a file, which appears, or replaces an earlier one, when it is whole.

    Raises RecordingError.
    """
    part = part_of(path)
    stream = new_stream(info)
    try:
        stream.save(part)
        yield stream
        stream.flush(timeout_sec=FLUSH_TIMEOUT)
        stream.disconnect()
        part.replace(path)
    except (RuntimeError, OSError) as error:
        abandon(stream)
        raise RecordingError(f"{path} cannot be written: {error}") from None
    except BaseException:
        abandon(stream)
        raise
    finally:
        part.unlink(missing_ok=True)


def sector_time(run: Run, first: int, last: int) -> float | None:
    """How long the Hall sectors from tick `first` to `last` lasted when the shaft last turned, s; None if it did not.

    The last three quarters of a minute are looked at.
    """
    second = run.info.tick_hz
    if EDGES not in run.names:
        return None
    for back in range(LOOKED_BACK // LOOK):
        end = last - back * LOOK * second
        begin = max(first, end - LOOK * second)
        ticks = [chunk.tick for segment in run.segments for chunk in segment.pieces(EDGES, begin, end)]
        found = np.diff(np.concatenate(ticks)) if ticks else np.zeros(0)
        if len(found) >= ENOUGH:
            return float(np.median(found)) / second
        if begin == first:
            break
    return None


def close_time(run: Run) -> float:
    """How much of a run the plots of its last moments show, s: so much that there is something to see."""
    if SAMPLES not in run.names:
        return WAVE
    config = run.config(SAMPLES)
    return max(WAVE, POINTS * config.decimation / config.pwm_hz)


def closeups(run: Run, first: int, last: int, and_end: bool = False) -> list[Span] | None:
    """What of the ticks `first` to `last` of a long run is shown sample by sample: what is near a fault or a mark.

    With `and_end` also the end, where a viewer opens.

    None where it is short, and all of it is.
    """
    second = run.info.tick_hz
    lengths = [min(last, segment.span[1]) - max(first, segment.span[0]) for segment in run.segments]
    if (
        sum(max(0, length) for length in lengths) <= CLOSE * second
        or 0 < run.rows(SAMPLES, first, last) <= MOST_SAMPLES
    ):
        return None
    faults = [event.tick for event in run.events if event.code == EventCode.FAULT]
    ticks = sorted({*faults, *(mark.first_tick for mark in run.marks)})
    around = round(AROUND * second)
    found: list[Span] = []
    chosen = [tick for tick in ticks if first <= tick <= last][:MOST_CLOSE]
    for tick in sorted({*chosen, min(last, run.span[1])}) if and_end else chosen:
        span = max(first, tick - around), min(last, tick + around)
        if found and span[0] <= found[-1][1]:
            found[-1] = found[-1][0], span[1]
        else:
            found.append(span)
    return found


def show(run: Run, log: RunLog, first: int, last: int, near: Sequence[Span] | None) -> None:
    """Log the ticks `first` to `last` of a run: sample by sample within the spans `near`, or all where that is None."""
    for mark in run.marks:
        if mark.first_tick <= last and mark.last_tick >= first:
            log.mark(mark)
    if near is None:
        for block in _blocks(run, first, last):
            log.block(block)
    else:
        _from_afar(run, log, first, last, near)
    if run.summary:
        log.summary(run.summary)


def _from_afar(run: Run, log: RunLog, first: int, last: int, near: Sequence[Span]) -> None:
    """Log an overview of a long run, the samples within the spans `near`, and all that was said."""
    bin_ticks = round(BIN * run.info.tick_hz)
    length = min(last, run.span[1]) - max(first, run.span[0])
    together = max(1, -(-length // (bin_ticks * BINS)))  # bins that are shown as one
    account, said = LossAccount(), _Said(run, first, last)
    if run.lost is not None:
        account.counters |= run.lost
    for segment, begin, end in _parts(run, first, last):
        log.block(Block([*segment.restarts]))
        for table in overviews(run, segment):
            ticks = numbers(table.column("tick"))
            shown = (ticks >= begin) & (ticks <= end)
            for a, b in near:
                shown &= (ticks < a - bin_ticks) | (ticks > b)
            if shown.any():
                log.overview(coarser(table.filter(pa.array(shown)), together), round(BIN * 1e9) * together)
        for a, b in near:
            if a <= end and b >= begin:
                for chunks in _windows(run, segment, max(a, begin), min(b, end)):
                    log.block(Block([*chunks]))
                if b < end:
                    log.left_out()
        log.block(said.block(account, end))
    rest = said.block(account, END)
    if run.lost is None:
        tick = min(last, run.span[1])
        rest.items.append(Note(tick, "losses are not counted: the run came to no end", "WARN"))
    log.block(rest)


def _blocks(run: Run, first: int, last: int) -> Iterator[Block]:
    """Everything from tick `first` to `last`, a window at a time; what happened before the samples comes first."""
    account, continuity = LossAccount(), Continuity()
    said = _Said(run, first, last)
    for segment, begin, end in _parts(run, first, last):
        segment.begin(continuity)
        yield Block([*segment.restarts])
        for window in _windows(run, segment, begin, end):
            chunks = [continuity.chunk(chunk) for chunk in window]
            for chunk in chunks:
                account.take(chunk)
            yield said.block(account, min(int(chunk.tick[0]) for chunk in chunks) - 1)
            yield said.block(account, max(int(chunk.tick[-1]) for chunk in chunks), chunks)
    for missing in run.missing:
        account.take(missing)
    yield said.block(account, END)


def _parts(run: Run, first: int, last: int) -> Iterator[tuple[Segment, int, int]]:
    """The segments of a run from tick `first` to `last`, and from where to where."""
    for segment in run.segments:
        begin, end = max(first, segment.span[0]), min(last, segment.span[1])
        if begin <= end:
            yield segment, begin, end


def _windows(run: Run, segment: Segment, begin: int, end: int) -> Iterator[list[Chunk]]:
    """The samples and edges of a segment, a window at a time."""
    step = round(WINDOW * close_time(run) / WAVE * run.info.tick_hz)
    waiting = {name: segment.pieces(name, begin, end) for name in run.names}
    held: dict[str, Chunk | None] = {name: next(pieces, None) for name, pieces in waiting.items()}
    for at in range(begin, end + 1, step):
        found: list[Chunk] = []
        for name, pieces in waiting.items():
            while (chunk := held[name]) is not None and int(chunk.tick[0]) < at + step:
                found.append(between(chunk, at, at + step - 1))
                if int(chunk.tick[-1]) >= at + step:
                    held[name] = between(chunk, at + step, END)
                    break
                held[name] = next(pieces, None)
        if found:
            yield found


class _Said:
    """Events, heartbeats, notes and changed parameters of a run, handed out with the samples that they came with."""

    def __init__(self, run: Run, first: int, last: int) -> None:
        said: tuple[list[tuple[int, Heard]], ...] = (
            [(event.tick, DeviceEventReceived(event.node, event)) for event in run.events],
            [(beat.heartbeat.tick, beat) for beat in run.heartbeats],
            [(note.tick, note) for note in run.notes],
            [(change.tick, change) for change in run.changes],
        )
        self._waiting = [deque(pair for pair in some if first <= pair[0] <= last) for some in said]

    def block(self, account: LossAccount, upto: int, chunks: Sequence[Chunk] = ()) -> Block:
        """These chunks, and what was said up to tick `upto`, with the losses up to then."""
        block = Block([*chunks])
        for waiting in self._waiting:
            while waiting and waiting[0][0] <= upto:
                _, item = waiting.popleft()
                account.take(item)
                block.items.append(item)
        block.losses = lost_components(account)
        return block
