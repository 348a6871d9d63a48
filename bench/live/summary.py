"""What a run comes to: counts, three-way losses, position errors, latency, CPU; as JSON and as tables.

`RunStatistics` is a sink that counts while the run goes on. `Summary` is what is left of it at the end.
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from bench.device.bus import bus_rows
from bench.device.client import WATCHDOG, Client
from bench.device.counters import DeviceCounters
from bench.device.description import describe
from bench.device.heard import Heard, Misdated, ParameterSet
from bench.files import finite
from bench.findings.motion import Came
from bench.report.words import number
from bench.signal.parameters import Change
from bench.signal.percentiles import Percentiles
from bench.signal.position import ErrorTable, Moments, position_errors, running, states
from bench.view import markdown
from bench.view.schema import label
from protocol.codes import fault_names
from protocol.host import DeviceEventReceived, HeartbeatReceived
from protocol.messages import Fault, Heartbeat, HelloReply
from protocol.streams import EdgeChunk, SampleChunk, StreamConfig
from protocol.text import counted

PAUSE = WATCHDOG  # s in which this program did not run, from which on a summary says so


MISDATED = 0.1  # s by which all samples are off the heartbeats around them, beyond which their time is wrong


class Dates:
    """Sink that compares the ticks of a drive's samples with its heartbeats; it needs each as it comes."""

    def __init__(self, drive: int) -> None:
        self._drive = drive
        self._newest: SampleChunk | None = None  # since the heartbeat before
        self._ages: list[int] = []  # ticks from the newest sample to each heartbeat: least and most
        self._step = 0  # ticks between samples

    def take(self, item: Heard) -> None:
        """Look at samples and heartbeats of the drive."""
        match item:
            case SampleChunk(config=StreamConfig(node=self._drive) as config):
                self._newest, self._step = item, config.index_step * config.tick_hz // config.pwm_hz
            case HeartbeatReceived(node=self._drive, heartbeat=heartbeat) if self._newest is not None:
                age = heartbeat.tick - int(self._newest.tick[-1])
                self._ages = [min(age, *self._ages), max(age, *self._ages)] if self._ages else [age, age]
                self._newest = None

    def wrong(self, tick_hz: int) -> str:
        """How far samples are dated wrongly by the drive's own clock; '' if they are not."""
        least, most = (age / tick_hz for age in self._ages or (0, 0))
        allowed = MISDATED + self._step / tick_hz
        if most >= -allowed and least <= allowed:
            return ""
        off, where = (least, "past") if least > allowed else (-most, "future")
        return (
            f"samples are dated {off:.2g} s in the {where} by the drive's own clock: tick0 or pwm_hz is not what it "
            "says, or not every PWM period is one of its samples'"
        )


class RunStatistics:
    """Sink that keeps the figures of a run; bounded memory. `segment` names the part of the run that is going on."""

    def __init__(self, drive: int, observers: HostObservers | None = None) -> None:
        self.drive = drive
        self.segment = "run"
        self.commanded = True
        """Whether the drive is told what to do: what it does after STOP is no figure of the run."""
        self.errors = ErrorTable()
        self.samples_seen = 0
        self.first_sample_unix: float | None = None  # s, wall clock: how long a start took
        self.edges_seen = 0
        self.faults = Fault(0)
        self.device = DeviceCounters()
        self.host_compared = 0
        self.host_differ = 0
        self.wrong_times: list[str] = []
        """What the drive dated as it cannot be."""
        self.mean: dict[str, float] = {}  # over the last chunk
        self._observers = observers
        self.dates = Dates(drive)

    def take(self, item: Heard) -> None:
        """Count; follow the drive's own counts and its faults."""
        match item:
            case SampleChunk():
                self._samples(item)
            case EdgeChunk():
                self.edges_seen += len(item)
                if self._observers is not None:
                    self._observers.edges(item)
            case HeartbeatReceived(node=self.drive, heartbeat=heartbeat):
                self._heartbeat(heartbeat)
            case Misdated(node=self.drive, text=text):
                self.wrong_times.append(text)
            case DeviceEventReceived(node=self.drive, event=event):
                self.faults |= event.faults
            case ParameterSet(tick, self.drive, name, value, exact) if self._observers is not None:
                self._observers.change(Change(tick, name, value), exact)

    def _samples(self, chunk: SampleChunk) -> None:
        """Count, and add position errors of the samples taken while the drive was running."""
        self.samples_seen += len(chunk)
        if self.first_sample_unix is None:
            self.first_sample_unix = time.time()
        errors = position_errors(chunk)
        if errors and (self.commanded or states(chunk) is not None):
            runs = running(chunk)
            self.errors.add(self.segment, {name: values[runs] for name, values in errors.items()})
        if self._observers is not None:
            compared, differ = self._observers.compare(chunk)
            self.host_compared += compared
            self.host_differ += differ
        for name in ("omega_enc", "i_q"):
            if name in (chunk.raw.dtype.names or ()):
                self.mean[name] = float(chunk.physical(name).mean())

    def _heartbeat(self, heartbeat: Heartbeat) -> None:
        self.device.add(heartbeat)
        self.faults |= heartbeat.faults  # its event may have been lost with the link

    def misdated(self, tick_hz: int) -> str:
        """What is wrong with the times that the drive tells; '' if nothing is."""
        if self.wrong_times:
            more = len(self.wrong_times) - 1
            return self.wrong_times[0] + (f", and {more} more" if more else "")
        return self.dates.wrong(tick_hz)


class CpuMeter:
    """CPU time of this process as a share of one core."""

    def __init__(self) -> None:
        self._wall = time.perf_counter()
        self._cpu = time.process_time()

    def percent(self) -> float:
        """CPU seconds per second since the meter was made, in percent of one core."""
        wall = time.perf_counter() - self._wall
        return 100 * (time.process_time() - self._cpu) / wall if wall > 0 else math.nan


if TYPE_CHECKING:
    from bench.replay.estimators import HostObservers


@dataclass
class Lost:
    """Losses by the three counts: sample index, frame sequence, the device's own."""

    samples_by_index: int = 0
    edges_by_index: int = 0
    frames_by_sequence: int = 0
    frames_by_device: int = 0


@dataclass
class Summary:
    """All figures of a run; angles in electrical degrees, times in s or ms by name."""

    target: str
    identity: dict[str, Any]
    duration_s: float
    samples: int
    edges: int
    lost: Lost
    position_error_deg: dict[str, dict[str, dict[str, float]]]
    cpu_percent: float
    longest_pause_s: float
    latency_ms: dict[str, float]
    link: dict[str, Any]
    first_sample_unix_s: float | None = None
    live_view: dict[str, Any] = field(default_factory=dict)
    recording: dict[str, Any] = field(default_factory=dict)
    at_fault: dict[str, Any] = field(default_factory=dict)
    """What the drive held at a fault, and the run that it became."""
    host_observers: dict[str, int] | None = None
    faults: list[str] = field(default_factory=list)
    distrusted: dict[str, float] | None = None
    """By Hall sensor that the drive distrusted, the share of the time; None where it does not tell."""
    moved: list[str] | None = None
    """The Hall sensors that the drive found to have moved; None likewise."""
    angle_lost: float | None = None
    """Share of the time for which the drive did not know the rotor's angle; None likewise."""
    motor: dict[str, dict[str, float | bool | None]] = field(default_factory=dict)
    """By parameter of the drive, what the run says that it should be, see `MotorValues.told`."""
    bus: dict[str, Any] | None = None
    result: str = "ok"
    asked: list[Came] = field(default_factory=list)
    outputs: str = ""
    """How they were seen at the end of a run that switched them on."""

    def as_json(self) -> dict[str, Any]:
        """Plain data; numbers that do not exist are null."""
        plain: dict[str, Any] = finite(asdict(self))
        return plain


def summarise(
    target: str,
    client: Client,
    stats: RunStatistics,
    identity: HelloReply,
    duration: float,
    cpu_percent: float,
    latency: Percentiles | None,
    bus: dict[str, Any] | None = None,
) -> Summary:
    """Put together what the client and the statistics have counted."""
    total = client.losses(stats.drive)
    samples, edges = total.samples, total.edges
    counters = client.session.counters
    return Summary(
        target=target,
        identity=describe(identity),
        duration_s=duration,
        samples=stats.samples_seen,
        edges=stats.edges_seen,
        lost=Lost(
            samples_by_index=samples.lost_by_index,
            edges_by_index=edges.lost_by_index,
            frames_by_sequence=samples.lost_by_seq + edges.lost_by_seq,
            frames_by_device=stats.device.risen["tx_dropped"],
        ),
        position_error_deg={
            segment: {name: _degrees(moments) for name, moments in row.items() if moments.n}
            for segment, row in stats.errors.segments.items()
            if any(moments.n for moments in row.values())
        },
        cpu_percent=cpu_percent,
        longest_pause_s=client.longest_pause,
        latency_ms={} if latency is None else {f"p{p}": 1e3 * latency.at(p) for p in (50, 95, 99, 100)},
        link={
            "outages": client.health.outages,
            "downtime_s": client.downtime,
            "reboots": client.health.reboots,
            "bytes": client.bytes_in,
            "frames": counters.framing.frames,
            "damaged": counters.framing.bad,
            "stale": samples.stale + edges.stale,
            "out_of_order": samples.out_of_order + edges.out_of_order,
            "late": samples.late + edges.late,
            "malformed": counters.malformed + samples.malformed + edges.malformed,
            "unknown": counters.unknown_types + counters.other_versions,
            "of_no_stream": client.unasked,
            "unexpected_replies": counters.unexpected_replies,
            "retries": counters.retries,
            "damaged_at_drive": stats.device.risen["rx_bad"],
            "setpoints_rejected": stats.device.risen["setpoints_rejected"],
        },
        host_observers={"compared": stats.host_compared, "different": stats.host_differ}
        if stats.host_compared
        else None,
        first_sample_unix_s=stats.first_sample_unix,
        faults=fault_names(stats.faults),
        bus=bus,
    )


ERROR_HEADERS = ("position error while running, electrical degrees", "estimate", "mean", "std", "max")


def error_rows(summary: Summary) -> list[list[str]]:
    """Position errors by segment and estimator, as text under ERROR_HEADERS."""
    return [
        [segment if first else "", label(name), f"{row['mean']:+.2f}", f"{row['std']:.2f}", f"{row['max']:.2f}"]
        for segment, by_name in summary.position_error_deg.items()
        for first, (name, row) in zip([True] + [False] * len(by_name), by_name.items(), strict=False)
    ]


ASKED_HEADERS = ("asked for, and seen in the last third", "r/min asked", "seen", "A load asked", "i_q seen")


def asked_rows(summary: Summary) -> list[list[str]]:
    """What was asked for and what came, as text under ASKED_HEADERS."""
    return [
        [
            came.title,
            number(came.speed_asked_rpm, "g"),
            number(came.speed_came_rpm, ".1f", "unknown"),
            number(came.load_asked_a, ".4g"),
            number(came.i_q_came_a, ".2f", "unknown"),
        ]
        for came in summary.asked
    ]


def run_rows(summary: Summary) -> list[list[str]]:
    """All values of a run that do not stand in a table of their own, as pairs of name and text."""
    lost, link, latency = summary.lost, summary.link, summary.latency_ms
    paused = summary.longest_pause_s >= PAUSE
    rows = [
        ["duration", f"{summary.duration_s:.1f} s"],
        ["samples", f"{summary.samples}"],
        ["edges", f"{summary.edges}"],
        ["lost by index", f"{counted(lost.samples_by_index, 'sample')}, {counted(lost.edges_by_index, 'edge')}"],
        ["lost by sequence", counted(lost.frames_by_sequence, "frame")],
        ["dropped by the drive", counted(lost.frames_by_device, "frame")],
        *_link_rows(link),
        ["CPU of the host", f"{summary.cpu_percent:.1f} % of a core"],
        *([["longest pause of this program", f"{summary.longest_pause_s:.2f} s"]] if paused else []),
        *([] if summary.bus is None else bus_rows(summary.bus)),
    ]
    if latency:
        rows.append(
            [
                "latency, sample to sink",
                " / ".join(f"{latency[k]:.0f}" for k in ("p50", "p99", "p100")) + " ms (p50 / p99 / max)",
            ]
        )
    if summary.live_view:
        rows.append(["dropped by the live view", counted(summary.live_view["blocks_dropped"], "block")])
        if summary.live_view["error"]:
            rows.append(["live view", f"failed: {summary.live_view['error']}"])
    if summary.recording:
        kept = summary.recording
        where = f"{kept['path']}" + (f" and {counted(kept['parts'] - 1, 'more part')}" if kept["parts"] > 1 else "")
        ring = f"; the last {kept['kept_s'] / 60:g} min are kept" if kept["kept_s"] else ""
        rows.append(["recorded", f"{kept['samples']} samples, {kept['edges']} edges in {where}{ring}"])
    if summary.at_fault:
        held = summary.at_fault
        what = f"{1e3 * (held['last_s'] - held['first_s']):.0f} ms, {held['records']} samples, {held['edges']} edges"
        rows.append(["held by the drive at the fault", f"{what} in {held['path']}"])
    if summary.host_observers:
        rows.append(
            [
                "host against drive",
                f"{summary.host_observers['different']} of {summary.host_observers['compared']} samples differ",
            ]
        )
    if summary.distrusted:
        told = ", ".join(f"{name} for {share:.1%} of the time" for name, share in summary.distrusted.items())
        rows.append(["Hall sensors that the drive distrusted", told])
    if summary.moved:
        rows.append(["Hall sensors that moved, as the drive found", ", ".join(summary.moved)])
    if summary.angle_lost:
        rows.append(["rotor's angle not known to the drive", f"{summary.angle_lost:.1%} of the time"])
    for name, said in summary.motor.items():
        value, within = said["value"], 3.0 * (said["sd"] or 0.0)
        found = "this run cannot tell" if said["wrong"] is None else f"{value:.3g} +/- {within:.2g}"
        rows.append([f"{name} by the run", f"{found}, in the drive {said['parameter']:.3g}"])
    if summary.outputs:
        rows.append(["outputs at the end", summary.outputs])
    rows.append(["faults", ", ".join(summary.faults) or "none"])
    rows.append(["result", summary.result])
    return rows


TRAFFIC = ("bytes", "frames")  # of a link: no trouble


def _link_rows(link: dict[str, Any]) -> list[list[str]]:
    """What went wrong on the link, a line for each count; one line if nothing did."""
    wrong = [
        [f"link, {name.removesuffix('_s').replace('_', ' ')}", f"{value:.1f} s" if name == "downtime_s" else f"{value}"]
        for name, value in link.items()
        if value and name not in TRAFFIC
    ]
    return wrong or [["link", "no outage, no reboot; nothing damaged, out of order, unknown, repeated or rejected"]]


def as_markdown(summary: Summary) -> str:
    """The summary as a markdown document, narrow enough for a column of the dashboard."""
    parts = ["### Summary", f"**Result: {markdown.escaped(summary.result)}**"]
    if summary.asked:
        rows = [[title, f"{rpm} → {seen}", f"{load} → {i_q}"] for title, rpm, seen, load, i_q in asked_rows(summary)]
        parts.append(markdown.table(("asked for → seen", "r/min", "load → i_q, A"), rows))
    if summary.position_error_deg:
        lines: list[list[str]] = []
        for segment, name, *values in error_rows(summary):
            lines += [[segment, "", "", ""]] if segment else []
            lines.append([f"– {name}", *values])
        parts.append(markdown.table(("position error, el. deg", "mean", "std", "max"), lines))
    parts.append(markdown.table(("run", ""), run_rows(summary)[:-1]))
    return "\n\n".join(parts)


def _degrees(moments: Moments) -> dict[str, float]:
    return {
        "n": moments.n,
        "mean": math.degrees(moments.mean),
        "std": math.degrees(moments.std),
        "max": math.degrees(moments.peak),
    }
