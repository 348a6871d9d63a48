"""Shows a run in a rerun stream: blocks of telemetry in, record batches and a few log calls out.

A `RunLog` belongs to one thread and one `RecordingStream`; it decides what is logged where, never when or whether.
Device time is the only time line. All samples of a block, or of a lot of them, go out as one message, their edges as
another; what the long plots and the stator plane need is logged at most ten times a second, health once a second,
because a viewer lags by messages, not by samples.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from bench.device.counters import DeviceCounters
from bench.device.heard import ClockRestarted, Note, ParameterSet
from bench.record.info import AnyChannel, Mark, RunInfo, ns_from_tick
from bench.record.layout import EDGE_FIELDS, numbers, stream_key, stream_name
from bench.record.overview import ERROR
from bench.signal.chunks import Chunk, join
from bench.signal.position import position_error
from bench.view import markdown, schema, states
from bench.view.blocks import Block
from bench.view.extent import Extents
from bench.view.hall_lanes import HallLanes
from bench.view.hall_returns import HallReturns
from bench.view.last_second import LastSecond
from bench.view.plane import Picture, Plane
from bench.view.plots import LEGEND_SHARE, TREND, Plot, left_out, plots, returns, trend_lines
from bench.view.scope import Pictures, Scope
from bench.view.trend import Rows, TrendBinner
from protocol.host import DeviceEventReceived, HeartbeatReceived
from protocol.messages import DeviceEvent, DriveState, EventCode, Heartbeat
from protocol.signals import STATUS_SOURCE_MASK, STATUS_SOURCE_SHIFT, STATUS_STATE_MASK, Status
from protocol.streams import EdgeChunk, SampleChunk, StreamConfig
from protocol.text import printable, told

REPEAT = 1.0  # s between repetitions of a state: late viewers get only the newest rows
PLANE_PERIOD = 0.1  # s between two pictures of the stator plane
TREND_BIN = 0.01  # s
TREND_LOT = 10  # bins, at least, that go out together
GUIDE_STEP, GUIDE_ROWS = 0.025, 4  # s between two rows of the guides, and how many go out together
ROOM_PERIOD = 0.5  # s, at least, between two rows that give the long plots of a live view room

_SHOWN_STATUS = np.uint8(0xFF & ~int(Status.OBSERVERS_RESET))  # ~ of the flag itself would keep known flags only
Values = NDArray[Any]
_STATE, _ARROWS = "StateChange:state", "Arrows2D:vectors"
_METADATA = {  # of columns that are no numbers of ours
    component: {
        "rerun:archetype": f"rerun.archetypes.{component.partition(':')[0]}",
        "rerun:component": component,
        "rerun:component_type": f"rerun.components.{kind}",
    }
    for component, kind in (
        (_STATE, "Text"),
        (_ARROWS, "Vector2D"),
        (schema.TEXTS, "Text"),
        (schema.PLACES, "Position2D"),
        (schema.STRIPS, "LineStrip2D"),
        (schema.STRIP_COLOURS, "Color"),
    )
}
_ARROW = pa.list_(pa.field("item", pa.float32(), nullable=False), 2)


class RunLog:
    """Logs one run to `stream`. Rows, but those of states and texts, go out every `lot` s or more.

    `live`: the long plots follow the newest sample, and their guides leave room for legends before the first. Samples
    and edges themselves are left to the recording.
    """

    def __init__(self, stream: rr.RecordingStream, run: RunInfo, lot: float = 0.0, live: bool = False) -> None:
        self.run = run
        self._stream = stream
        self._now_ns = 0  # newest device time seen
        self._restarted = False  # the drive's clock, and nothing has been seen since
        self._streams: dict[object, _Stream] = {}
        self._by_config: dict[StreamConfig, _Stream] = {}
        self._layouts: dict[tuple[str, ...], pa.Schema] = {}
        self._lanes: dict[str, str] = dict.fromkeys(states.lanes(run), states.UNKNOWN)
        self._drive = states.drive_entity(run)
        self._lanes_ns = 0
        self._hall = HallLanes(run)
        self._returns, self._returns_lines = HallReturns(), [line for plot in returns(run) for line in plot.lines]
        self.marks: list[Mark] = []
        self._losses: dict[str, int] = dict.fromkeys(schema.LOSS_FIELDS, 0)
        self._device = DeviceCounters()
        self._status: int | None = None  # last value of the status channel
        self._next_health_ns = self._next_plane_ns = self._next_room_ns = 0
        bands, means = trend_lines(run)
        self._trend_lines = [*bands, *means]
        self._trend = TrendBinner(round(TREND_BIN * 1e9), len(bands), max(TREND_LOT, round(lot / TREND_BIN)))
        shown = [plot for plot in plots(run).values() if plot.entity == schema.TREND or plot.least]
        self._guides = [plot for plot in shown if plot.entity == schema.FAST]
        self._rooms = [plot for plot in shown if plot.entity == schema.TREND]
        self._live = live
        self._guided_ns = 0
        self.extents = None if live else Extents()
        self._first_ns: int | None = None  # of the run, or since the drive has rebooted
        self._last_second = LastSecond(run)
        self._scope = Scope(run)
        self._plane = Plane(run)
        self._pictures: list[tuple[int, Picture]] = []
        self._lot_ns, self._next_lot_ns = round(lot * 1e9), 0
        self._held: dict[tuple[str, ...], list[pa.RecordBatch]] = {}  # for the next lot, by entity and columns

    # -- static -------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Log what does not change: identity, colours of states, the stator plane's frame."""
        log = self._stream.log
        for entity, colours in states.state_colours(self.run).items():
            log(entity, states.configuration(colours), static=True)
        for entity, parts in (*self._plane.frame(), *self._last_second.frame(), *self._scope.frame()):
            log(entity, parts, static=True)

    def summary(self, markdown: str) -> None:
        """Show the summary from now on, whatever the moment that is looked at."""
        self._stream.log(schema.RUN_TEXT, _markdown(markdown), static=True)

    # -- blocks -------------------------------------------------------------------------------------------------

    def block(self, block: Block) -> None:
        """Log everything in `block`. A float channel may hold anything: infinite and NaN are no reason to warn."""
        with np.errstate(invalid="ignore", over="ignore"):
            self._block(block)

    def _block(self, block: Block) -> None:
        self._losses |= block.losses
        self._restarted |= any(restarted.node == self.run.node for restarted in block.of(ClockRestarted))
        for stream, edges in self._by_stream(block.of(EdgeChunk)):
            self._edges(stream, join(edges))
        for stream, samples in self._by_stream(block.of(SampleChunk)):
            self._samples(stream, join(samples))
        self._send_close_ups(self._scope.pictures())
        if self._now_ns >= self._next_lot_ns:
            self._next_lot_ns = self._now_ns + self._lot_ns
            self._send_lot()
        self._log_last_second()
        for node, event in block.of(DeviceEventReceived):
            self._event(node, event)
        for node, heartbeat in block.of(HeartbeatReceived):
            self._heartbeat(node, heartbeat)
        for tick, text, level in [*block.of(Note), *map(_set, block.of(ParameterSet))]:
            self._at(int(ns_from_tick(tick, self.run.tick_hz)))
            self._stream.log(schema.NOTES, _line(text, level))
        if self._lanes_ns and self._now_ns - self._lanes_ns >= REPEAT * 1e9:
            self._log_lanes(self._now_ns)
        self._health()

    def overview(self, table: pa.Table, bin_ns: int) -> None:
        """Log minima and maxima, see `bench.record.overview`, in the place of samples.

        The minimum stands at the start of a bin of `bin_ns`, the maximum at its middle.
        """
        t_ns = np.repeat(ns_from_tick(numbers(table.column("tick")), self.run.tick_hz), 2)
        t_ns[1::2] += bin_ns // 2
        self._reach(int(t_ns[-1]))
        columns = [_Column(channel) for channel in self.run.channels if f"{channel.name}.min" in table.column_names]
        values = {c.name: c.physical({c.name: _band(table, c.name)}) for c in columns}
        errors = {
            schema.error_component(name): _band(table, f"{ERROR}{name}")
            for name in self.run.position_estimates
            if f"{ERROR}{name}.min" in table.column_names
        }
        shown = {column.component: pa.array(values[column.name]) for column in columns}
        shown |= {component: pa.array(error) for component, error in errors.items()}
        values |= errors
        self._send(schema.FAST, t_ns, shown)
        if "u_dc" in values:
            values[schema.U_LIMIT] = _limit(values["u_dc"])
        trends: dict[str, NDArray[np.float32]] = {}
        for line in self._trend_lines:
            try:
                value = line.of(values)
            except KeyError:  # it has no minima and maxima of its own
                continue
            if line.mean:  # what is known of it is its least and its most: in between lies the mean of both
                value = np.repeat((value[::2] + value[1::2]) / 2, 2)
            trends[line.component] = value.astype(np.float32)
        if trends:
            self._send_rows(t_ns, trends)
        self._send_lot()

    def mark(self, mark: Mark) -> None:
        """Log a stretch of an acceptance run; the lane that shows it is drawn by `finish`, from all of them."""
        self.marks.append(mark)
        seconds = f"{mark.first_tick / self.run.tick_hz:.3f} … {mark.last_tick / self.run.tick_hz:.3f} s"
        self._at(int(ns_from_tick(mark.first_tick, self.run.tick_hz)))
        level = "INFO" if mark.verdict is None else states.MARK_LEVELS.get(mark.verdict, "INFO")
        self._stream.log(schema.NOTES, _line(f"{mark.verdict or 'mark:'} {mark.name}, {seconds}", level))

    def touch(self) -> None:
        """Log something that changes nothing, at the newest time seen.

        Rerun (0.41) draws a plot's lines shifted by the last step of a time cursor that follows, until something new
        arrives.
        """
        self._at(self._now_ns)
        self._stream.log(schema.TOUCH, rr.AnyValues(touch=np.int64(0)))

    def finish(self) -> None:
        """Log what was held back: for a bin or a second that is not full yet, or until all marks are known."""
        self._send_rest()
        for plot in self._rooms if self.extents is not None else ():
            extent = None if self.extents is None else self.extents.of(plot)
            if extent is not None and len(extent.marks):
                self._send(schema.BEYOND, extent.t_ns, {plot.beyond: pa.array(extent.marks)})
        if self.marks:
            lane, colours = states.mark_lane(self.marks, self.run.tick_hz)
            self._stream.log(schema.ACCEPTANCE, states.configuration(colours), static=True)
            for tick, words in lane:
                self._at(int(ns_from_tick(tick, self.run.tick_hz)))
                self._stream.log(schema.ACCEPTANCE, rr.StateChange(state=[words]))
        self._next_health_ns = 0
        self._health()
        self._send_lot()

    def _reach(self, t_ns: int) -> None:
        """Device time has come to `t_ns`; when its clock has restarted it starts anew."""
        if self._restarted:
            self._restarted = False
            self._send_rest()
            self._next_plane_ns = self._next_health_ns = self._next_room_ns = self._next_lot_ns = t_ns
            self._lanes_ns = self._now_ns = t_ns
            self._hall.restart()
            self._returns.restart()
            self._last_second.restart()
            self._scope.restart()
            self._first_ns = None
        self._now_ns = max(self._now_ns, t_ns)

    def _samples(self, stream: _Stream, chunk: SampleChunk) -> None:
        t_ns = ns_from_tick(chunk.tick, self.run.tick_hz)
        self._reach(int(t_ns[-1]))
        values = {column.name: column.physical(chunk.raw) for column in stream.columns}
        shown = stream.columns if not self._live or stream.entity != schema.FAST else ()
        columns = {column.component: pa.array(values[column.name]) for column in shown}
        if stream.entity != schema.FAST:
            self._send(stream.entity, t_ns, columns)
            return
        errors = self._errors(values)
        values |= _derived(values)
        if not self._live:
            columns |= {schema.error_component(name): pa.array(error) for name, error in errors.items()}
            columns |= {schema.derived_component(name): pa.array(values[name]) for name in _DERIVED if name in values}
            self._send(stream.entity, t_ns, columns)
            self._send_guide(int(t_ns[0]), int(t_ns[-1]))
            self._hall.samples(t_ns, chunk.raw)
        self._last_second.samples(chunk, values, errors)
        self._telemetry_lane(t_ns, chunk)
        self._status_lanes(chunk, t_ns)
        self._send_returns(chunk)
        quantities = values | {schema.error_component(name): error for name, error in errors.items()}
        self._scope.samples(chunk, quantities)
        self._add_trend(t_ns, quantities)
        if t_ns[-1] >= self._next_plane_ns:
            self._next_plane_ns = int(t_ns[-1] + PLANE_PERIOD * 1e9)
            newest = {name: float(value[-1]) for name, value in values.items()}
            picture = self._plane.picture(newest, {n: float(e[-1]) for n, e in errors.items()})
            if picture is not None:
                self._pictures.append((int(t_ns[-1]), picture))

    def _edges(self, stream: _Stream, chunk: EdgeChunk) -> None:
        t_ns = ns_from_tick(chunk.tick, self.run.tick_hz)
        self._reach(int(t_ns[-1]))
        if not self._live:
            self._send(stream.entity, t_ns, {f"edge:{name}": pa.array(getattr(chunk, name)) for name in EDGE_FIELDS})
        if stream.entity == schema.HALL:
            if not self._live:
                self._hall.edges(t_ns, chunk.hall_new)
            self._scope.edges(chunk)
            self._returns.edges(chunk)
            self._last_second.edges(chunk)

    def _send_returns(self, chunk: SampleChunk) -> None:
        """Log bounces and pulses of the seconds that have ended with these samples."""
        if not self._returns_lines:
            return
        ends, counts = self._returns.samples(chunk)
        if len(ends):
            columns = zip(self._returns_lines, counts.T, strict=True)
            values = {line.component: pa.array(count.astype(np.float32)) for line, count in columns}
            self._send(schema.RETURNS, ns_from_tick(ends, self.run.tick_hz), values)

    def _send_rest(self) -> None:
        self._send_trend(self._trend.rest())
        self._send_lot()

    def _send_lot(self) -> None:
        """Log what was held since the last time."""
        t_ns, codes = self._hall.take()
        if len(t_ns):
            self._send(schema.HALL_LANES, t_ns, {_STATE: states.HALL_WORDS.take(pa.array(codes))})
        self._send_pictures()
        for (entity, *_), batches in self._held.items():
            for batch in pa.Table.from_batches(batches).combine_chunks().to_batches() if len(batches) > 1 else batches:
                self._stream.send_record_batch(batch, index=schema.TIMELINE, entity_path=entity)
        self._held = {}

    def _log_last_second(self) -> None:
        """Log the pictures of the last second, if it is time for them."""
        if (tick := self._last_second.due()) is not None:
            self._at(int(ns_from_tick(tick, self.run.tick_hz)))
            for entity, part in self._last_second.pictures():
                self._stream.log(entity, part)

    def left_out(self) -> None:
        """Say in the close-ups that samples are left out from here on."""
        self._send_close_ups(self._scope.left_out())

    def _send_close_ups(self, found: tuple[int, Pictures] | None) -> None:
        tick, pictures = found or (0, {})
        t_ns = np.array([ns_from_tick(tick, self.run.tick_hz)])
        for entity, picture in pictures.items():
            self._send(entity, t_ns, picture.columns())

    def _send_pictures(self) -> None:
        """Log the pictures of the stator plane since the last time."""
        pictures, self._pictures = self._pictures, []
        if pictures:
            t_ns = np.array([at for at, _ in pictures])
            arrows, labels = zip(*(picture for _, picture in pictures), strict=True)
            self._send(schema.VECTORS, t_ns, {_ARROWS: pa.array(arrows, pa.list_(_ARROW))})
            self._send(schema.LEGEND, t_ns, {schema.TEXTS: pa.array(labels, pa.list_(pa.string()))})

    def _by_stream(self, chunks: Sequence[Chunk]) -> list[tuple[_Stream, list[Chunk]]]:
        groups: dict[str, tuple[_Stream, list[Chunk]]] = {}
        for chunk in chunks:
            stream = self._by_config.get(chunk.config) or self._stream_of(chunk.config)
            groups.setdefault(stream.entity, (stream, []))[1].append(chunk)
        return list(groups.values())

    def _stream_of(self, config: StreamConfig) -> _Stream:
        key = stream_key(config)
        stream = self._streams.get(key)
        if stream is None:
            entity = stream_name(config, self.run.node, [known.entity for known in self._streams.values()])
            stream = self._streams[key] = _Stream(entity, tuple(map(_Column, config.channels)))
        self._by_config[config] = stream
        return stream

    def _at(self, t_ns: int) -> None:
        self._stream.set_time(schema.TIMELINE, duration=np.timedelta64(t_ns, "ns"))

    def _send(self, entity: str, t_ns: NDArray[np.int64], columns: Mapping[str, pa.Array]) -> None:
        """Hold rows of an entity for the next lot."""
        arrays = [pa.array(t_ns.view("timedelta64[ns]")), *columns.values()]
        shape = (entity, *columns)
        layout = self._layouts.get(shape)
        if layout is None:
            names = (schema.TIMELINE, *columns)
            fields = [pa.field(n, a.type, metadata=_METADATA.get(n)) for n, a in zip(names, arrays, strict=True)]
            layout = self._layouts[shape] = pa.schema(fields)
        self._held.setdefault(shape, []).append(pa.RecordBatch.from_arrays(arrays, schema=layout))

    def _errors(self, values: Mapping[str, Values]) -> dict[str, Values]:
        """Position errors, actual minus estimated, in electrical degrees by estimate."""
        reference = self.run.position_reference
        if reference is None:
            return {}
        return {
            name: (position_error(values[reference], values[name]) * schema.DEG).astype(np.float32, copy=False)
            for name in self.run.position_estimates
        }

    def _add_trend(self, t_ns: NDArray[np.int64], values: Mapping[str, Values]) -> None:
        if self._trend_lines:
            found = [line.of(values) for line in self._trend_lines]
            self._send_trend(self._trend.add(t_ns, np.stack(found).astype(np.float32, copy=False)))

    def _send_trend(self, rows: Rows | None) -> None:
        if rows is not None:
            t_ns, values = rows
            self._send_rows(t_ns, {line.component: row for line, row in zip(self._trend_lines, values, strict=True)})

    def _send_rows(self, t_ns: NDArray[np.int64], rows: Mapping[str, NDArray[np.float32]]) -> None:
        """Log what the long plots show, by component."""
        self._send(schema.TREND, t_ns, {name: pa.array(row) for name, row in rows.items()})
        if self._first_ns is None:
            self._first_ns = int(t_ns[0])
        self._send_room(int(t_ns[-1]), {name: float(row[-1]) for name, row in rows.items()})
        if self.extents is not None:
            self.extents.add(t_ns, rows)

    def _send_room(self, t_ns: int, newest: Mapping[str, float]) -> None:
        """Log where the long plots begin at least, and how far they reach; `newest`: values by component."""
        if self._live and t_ns < self._next_room_ns:
            return
        self._next_room_ns = t_ns + round(ROOM_PERIOD * 1e9)
        start = t_ns
        if self._live and self._first_ns is not None:
            shown = min(round(TREND * 1e9), t_ns - self._first_ns)
            start -= round(shown / (1 - LEGEND_SHARE))
        columns = {plot.guide: pa.array(_least(plot, newest), pa.float32()) for plot in self._rooms}
        if columns:
            self._send(schema.ROOM, np.array([start, t_ns]), columns)

    def _send_guide(self, first_ns: int, last_ns: int) -> None:
        """Log how far the plots of the last moments reach at least; a few rows in one message."""
        step = round(GUIDE_STEP * 1e9)
        begin = max(self._guided_ns, first_ns - first_ns % step) if last_ns > self._guided_ns else first_ns
        t_ns = np.arange(begin, last_ns + 1, step)
        if len(t_ns) < GUIDE_ROWS:
            return
        self._guided_ns = int(t_ns[-1]) + step
        signs = np.where(t_ns // step % 2, 1.0, -1.0).astype(np.float32)
        if self._guides:
            self._send(schema.GUIDE, t_ns, {plot.guide: pa.array(plot.least * signs) for plot in self._guides})

    # -- states, events, health ---------------------------------------------------------------------------------

    def _lane(self, t_ns: int, **words: str) -> None:
        """Log the drive's lanes if one of them changes; never before what was logged of them: a heartbeat is older."""
        if any(self._lanes[lane] != word for lane, word in words.items()):
            self._lanes |= words
            self._log_lanes(max(t_ns, self._lanes_ns))

    def _log_lanes(self, t_ns: int) -> None:
        self._lanes_ns = t_ns
        self._at(t_ns)
        self._stream.log(self._drive, rr.StateChange(state=list(self._lanes.values())))

    def _telemetry_lane(self, t_ns: NDArray[np.int64], chunk: SampleChunk) -> None:
        if not chunk.gaps and self._lanes["telemetry"] == states.COMPLETE:
            return
        step = round(chunk.config.index_step * 1e9 / self.run.pwm_hz)
        for gap in chunk.gaps:
            end = int(t_ns[gap.position])
            if gap.lost_samples:
                self._lane(max(0, end - gap.lost_samples * step), telemetry=states.GAP)
            self._lane(end, telemetry=states.COMPLETE)
        self._lane(int(t_ns[0]), telemetry=states.COMPLETE)

    def _status_lanes(self, chunk: SampleChunk, t_ns: NDArray[np.int64]) -> None:
        if "status" not in self.run.words:
            return
        words = chunk.raw["status"] & _SHOWN_STATUS
        rows = (np.flatnonzero(words[1:] != words[:-1]) + 1).tolist()
        if words[0] != self._status:
            rows = [0, *rows]
        for row in rows:
            word = int(words[row])
            self._lane(
                int(t_ns[row]),
                state=DriveState(word & STATUS_STATE_MASK).name,
                angle=states.angle_text(
                    (word & STATUS_SOURCE_MASK) >> STATUS_SOURCE_SHIFT, bool(word & Status.CORRECTION_ON)
                ),
            )
        self._status = int(words[-1])

    def _event(self, node: int, event: DeviceEvent) -> None:
        t_ns = int(ns_from_tick(event.tick, self.run.tick_hz))
        self._reach(t_ns)
        self._at(t_ns)
        level = states.EVENT_LEVELS.get(event.code, "INFO")
        self._stream.log(schema.EVENTS, _line(states.event_text(node, event), level))
        state = event.number if event.code == EventCode.STATE_CHANGED else None
        if state is not None and node == self.run.node and self._status is None:
            self._lane(t_ns, state=DriveState(state).name)

    def _heartbeat(self, node: int, heartbeat: Heartbeat) -> None:
        if node != self.run.node:
            return
        t_ns = int(ns_from_tick(heartbeat.tick, self.run.tick_hz))
        self._reach(t_ns)
        self._device.add(heartbeat)
        if self._status is None:  # no status channel, or no samples yet
            self._lane(t_ns, state=heartbeat.state.name)
        self._lane(t_ns, faults=states.fault_text(heartbeat.faults | heartbeat.first_fault))

    def _health(self) -> None:
        if self._now_ns < self._next_health_ns or not (self._device.seen or self._streams):
            return
        self._next_health_ns = self._now_ns + 1_000_000_000
        values: dict[str, int] = dict(self._losses)
        if self._device.seen:
            for name in ("rx_bad", "setpoints_rejected"):
                values[f"health:{name}"] = self._device.risen[name]
        columns = {name: pa.array(np.array([value], np.float64)) for name, value in values.items()}
        self._send(schema.HEALTH, np.array([self._now_ns], np.int64), columns)
        self._at(self._now_ns)
        self._stream.log(schema.RUN_TEXT, _markdown(f"{health_text(values)}\n\n{identity_text(self.run)}"))


class _Column:
    """A channel's column, its constants looked up once."""

    def __init__(self, channel: AnyChannel) -> None:
        self.name = channel.name
        self.component = schema.value_component(channel.name)
        self._kind = schema.storage(channel)
        self._scale, self._offset = self._kind(channel.scale), self._kind(channel.offset)

    def physical(self, raw: Mapping[str, NDArray[Any]] | NDArray[np.void]) -> Values:
        """raw * scale + offset in the channel's `storage` format, shape (n,)."""
        values: Values = np.multiply(raw[self.name], self._scale, dtype=self._kind)
        return values + self._offset if self._offset else values


@dataclass(slots=True)
class _Stream:
    """Where a stream goes."""

    entity: str
    columns: tuple[_Column, ...]


_DERIVED = (schema.U_ABS, schema.U_LIMIT)


def _limit(u_dc: Values) -> Values:
    limit: Values = u_dc / np.float32(np.sqrt(3))
    return limit


def _derived(values: Mapping[str, Values]) -> dict[str, Values]:
    """Quantities that no channel holds, (n,) each, of those of which there is everything."""
    found: dict[str, Values] = {}
    if "u_dc" in values:
        found[schema.U_LIMIT] = _limit(values["u_dc"])
    if all(name in values for name in schema.VOLTAGE_VECTOR):
        found[schema.U_ABS] = np.hypot(*(values[name] for name in schema.VOLTAGE_VECTOR))
    return found


def _least(plot: Plot, newest: Mapping[str, float]) -> list[float]:
    """The ends of the least range of a plot."""
    centre = 0.0 if plot.about_zero else newest.get(plot.lines[0].component, 0.0)
    return [centre - plot.least, centre + plot.least]


def _band(table: pa.Table, name: str) -> NDArray[Any]:
    """Minima and maxima in turn, shape (2 bins,)."""
    return np.stack([numbers(table.column(f"{name}.{end}")) for end in ("min", "max")], axis=1).reshape(-1)


def identity_text(run: RunInfo) -> str:
    """What is running, and what of it is not shown."""
    rows: list[tuple[str, object]] = [("started", run.started)] if run.started else []
    if "imported" not in run.identity:
        rows += [("tick rate", f"{run.tick_hz / 1e6:g} MHz"), ("PWM", f"{run.pwm_hz / 1e3:g} kHz")]
    rows += [(key, told(value)) for key, value in run.identity.items()]
    rows += [("not shown", why) for why in left_out(run)]
    return markdown.table(("what is tested", ""), rows)


def health_text(values: Mapping[str, int]) -> str:
    """Losses and errors so far as a small table; `values` by component name."""
    v = {name: f"**{value}**" if value else "0" for name, value in values.items()}
    damaged, rejected = (v.get(f"health:{name}", "–") for name in ("rx_bad", "setpoints_rejected"))
    return "\n".join(
        [
            "| lost so far | |",
            "|---|---|",
            f"| samples, by index | {v['lost:samples']} |",
            f"| Hall edges, by index | {v['lost:edges']} |",
            f"| frames, by sequence | {v['lost:sample_frames']} |",
            f"| frames dropped by the drive | {v['lost:by_device']} |",
            f"| blocks, live view only | {v['lost:live_blocks']} |",
            f"| frames damaged at the drive | {damaged} |",
            f"| setpoints rejected | {rejected} |",
        ]
    )


def _markdown(text: str) -> rr.TextDocument:
    whole = text.encode(errors="backslashreplace").decode()  # a file's name may hold halves of characters
    return rr.TextDocument(whole, media_type=rr.MediaType.MARKDOWN)


def _set(change: ParameterSet) -> Note:
    """That a parameter was set, as a line."""
    return Note(change.tick, f"node {change.node}: {change.name} = {change.value:.7g}")


def _line(text: str, level: str) -> rr.TextLog:
    return rr.TextLog(printable(text), level=level, color=states.LEVEL_COLOURS.get(level, states.LINE_COLOUR))
