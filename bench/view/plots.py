"""What the plots of a run show: which numbers, from which channels, under which names, in which colours.

The writer (`log`) and the layout (`dashboard`) both take it from here, so every line of a plot has its data. Channels
that the vocabulary knows, by name or by flag, have their plots; all others are plotted by unit. Imports no rerun.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.record.info import AnyChannel, RunInfo
from bench.signal.colours import RGB, SPARES, TABLE
from bench.view import schema
from protocol.signals import Flag

TREND, WAVE = 25.0, 0.2  # seconds that the plots show
LEGEND_SHARE = 0.3  # of a plot's width, left free of data for its legend
ANGLE_RANGE = (-3.3, 3.3)  # rad
LEAST_ERROR, LEAST_CURRENT, LEAST_SPEED, LEAST_VOLTAGE = 2.0, 0.1, 5.0, 0.2
"""deg, A, r/min or rad/s, V: half of what a plot shows at least, so that noise at rest does not look like a signal."""
QUANTITIES = {
    "V": "Voltages",
    "A": "Currents",
    "rad": "Angles",
    "rad/s": "Speeds",
    "N·m": "Torques",
    "°C": "Temperatures",
    "W": "Powers",
}
OTHER = "Other channels"
BUS = "DC link and voltage vector [V]"
LIMIT_COLOUR: RGB = (200, 196, 190)
Range = tuple[float, float] | None
LINES = 8  # of a plot by unit: not more than there are spare colours
ALONE = 16  # channels without a unit, of which nobody knows whether they compare: so many have a plot each
POINTS = 200  # of a line that a plot of the last moments of a recording shows at least


@dataclass(frozen=True)
class Line:
    """One line of a plot: its component, the channel it comes from, its name and colour.

    It shows the channel's value times `factor`, the position `error` of an estimate, or what is `derived` from it and
    others; over the long run as the band between minimum and maximum, or as `mean`.
    """

    component: str
    channel: str
    name: str
    colour: RGB
    factor: float = 1.0
    error: bool = False
    mean: bool = False
    derived: str = ""
    unseen: bool = False
    points: bool = False

    @property
    def quantity(self) -> str:
        """What it shows, among values by channel, by derived quantity, and by component of position errors."""
        return self.component if self.error else self.derived or self.channel

    def of(self, values: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
        """What it shows, (n,), of values (n,) by quantity. Raises KeyError without it."""
        value = values[self.quantity]
        return value if self.factor == 1.0 else value * np.float32(self.factor)


@dataclass(frozen=True)
class Plot:
    """A time series plot of lines of one entity, TREND or FAST; `by_unit` if the vocabulary has none for them."""

    name: str
    entity: str
    lines: tuple[Line, ...]
    y_range: Range = None
    by_unit: bool = False
    seconds: float = WAVE
    """How far back it shows."""
    marked: bool = False
    """Whether it leaves peaks out and marks them."""
    least: float = 0.0
    """Half of the range that it shows at least,"""
    about_zero: bool = True
    """about 0, or about the newest value of its first line."""
    guide: str = ""
    """Component of the line without a colour that sees to it, see `schema.GUIDE`."""

    @property
    def title(self) -> str:
        """Its name without the time that it shows."""
        return self.name.rpartition(", last")[0]

    @property
    def beyond(self) -> str:
        """Component of the marks where it leaves peaks out, see `schema.BEYOND`."""
        return f"beyond:{self.guide}"


def plots(run: RunInfo) -> dict[str, Plot]:
    """The plots that the run's channels allow, by key: every channel is in one of them, or in a timeline of states."""
    known = {key: plot for key, plot in _known(run).items() if plot.lines}
    shown = run.words | {line.channel for plot in known.values() for line in plot.lines if not line.derived}
    found = known | _by_unit(run, [channel for channel in run.channels if channel.name not in shown])
    return {key: replace(plot, guide=f"guide:{key}") for key, plot in found.items()}


def waves_by_unit(run: RunInfo) -> list[Plot]:
    """All channels that are numbers, sample by sample, a plot for each unit."""
    numbers = [channel for channel in run.channels if channel.name not in run.words]
    found = [plot for plot in _by_unit(run, numbers).values() if plot.entity == schema.FAST]
    return [replace(plot, name=plot.title) for plot in found]


def trend_lines(run: RunInfo) -> tuple[list[Line], list[Line]]:
    """The lines over the long run, each once: those shown as bands, and those shown as means."""
    lines = {line.component: line for plot in plots(run).values() if plot.entity == schema.TREND for line in plot.lines}
    return [line for line in lines.values() if not line.mean], [line for line in lines.values() if line.mean]


def returns(run: RunInfo) -> tuple[Plot, ...]:
    """Bounces a second and pulses a second, by Hall sensor; none of a drive that streams no edges."""
    if "edges" not in run.identity.get("features", ("edges",)):
        return ()
    lines = {
        what: tuple(Line(f"returns:{what} {n}", "", n, look.rgb) for n, look in zip("abc", SPARES, strict=False))
        for what in ("bounces", "pulses")
    }
    return tuple(Plot(f"{what.title()} a second", schema.RETURNS, its, seconds=TREND) for what, its in lines.items())


def left_out(run: RunInfo) -> list[str]:
    """What a run does not show of its motor, and what it would take."""
    needs = (
        ("position error", "a position flagged REFERENCE", run.position_reference),
        ("position error", "a position flagged ESTIMATE", run.position_estimates),
        ("mechanical speed", "the parameter n_p, a whole number from 1 up", run.n_p or not run.speeds),
        ("Hall sensors", "the channel hall, or edges", run.hall),
    )
    return [f"{view}: needs {need}" for view, need, there in needs if not there]


def _known(run: RunInfo) -> dict[str, Plot]:
    speed = f"Speed, {'mechanical' if run.n_p else 'electrical'} [{run.speed_unit}]"
    errors = _errors(run)
    angles = [name for name in (run.position_reference, *run.position_estimates) if name]
    wraps = all(channel.flags & Flag.WRAPS for channel in run.channels if channel.name in angles)
    error = "Position error, electrical [°]"
    dq = (
        *_values(run, filter(run.has, schema.DQ_CURRENTS)),
        *_values(run, filter(run.has, schema.DQ_REFERENCES), mean=True),
    )
    phases = _values(run, filter(run.has, schema.PHASES))
    bus = _bus(run)
    return {
        "error_trend": _trend(error, errors, least=LEAST_ERROR),
        "speed": _trend(speed, _speeds(run), least=LEAST_SPEED, about_zero=False),
        "dq": _trend("d/q currents [A]", dq, least=LEAST_CURRENT),
        "bus": _trend(BUS, bus, least=LEAST_VOLTAGE, about_zero=False),
        "position": _wave(
            "Rotor position, electrical [rad]", _values(run, angles), y_range=ANGLE_RANGE if wraps else None
        ),
        "error": _wave(error, errors, least=LEAST_ERROR),
        "phases": _wave("Phase currents [A]", phases, least=LEAST_CURRENT),
        "bus_wave": _wave(BUS, bus),
    }


def _trend(name: str, lines: tuple[Line, ...], **more: Any) -> Plot:
    return Plot(f"{name}, min/max, last {TREND:g} s", schema.TREND, lines, seconds=TREND, **more)


def _wave(name: str, lines: tuple[Line, ...], **more: Any) -> Plot:
    return Plot(f"{name}, last {WAVE:g} s", schema.FAST, lines, **more)


def _errors(run: RunInfo) -> tuple[Line, ...]:
    estimates = run.position_estimates if run.position_reference else ()
    return tuple(
        Line(schema.error_component(name), name, schema.label(name), run.colours[name], error=True)
        for name in estimates
    )


def _speeds(run: RunInfo) -> tuple[Line, ...]:
    references = (schema.SPEED_REFERENCE,) if run.has(schema.SPEED_REFERENCE) else ()
    component = schema.speed_component if run.n_p else schema.value_component
    return tuple(
        _line(run, component(name), name, mean, run.speed_factor)
        for name, mean in [*((name, False) for name in run.speeds), *((name, True) for name in references)]
    )


def _bus(run: RunInfo) -> tuple[Line, ...]:
    """The DC link, and beside it how much of it the voltage vector takes."""
    if not run.has("u_dc"):
        return ()
    lines = list(_values(run, ["u_dc"]))
    for quantity, channel, colour in (
        (schema.U_LIMIT, "u_dc", LIMIT_COLOUR),
        (schema.U_ABS, "u_alpha", TABLE["u_alpha"].rgb),
    ):
        if run.has(*schema.VOLTAGE_VECTOR):
            lines.append(Line(schema.derived_component(quantity), channel, schema.label(quantity), colour,
                              derived=quantity))  # fmt: skip
    return tuple(lines)


def _values(run: RunInfo, names: Iterable[str], mean: bool = False) -> tuple[Line, ...]:
    return tuple(_line(run, schema.value_component(name), name, mean) for name in names)


def _line(run: RunInfo, component: str, name: str, mean: bool, factor: float = 1.0) -> Line:
    return Line(
        schema.mean_component(component) if mean else component,
        name,
        schema.label(name),
        run.colours[name],
        factor=factor,
        mean=mean,
    )


def _by_unit(run: RunInfo, channels: Iterable[AnyChannel]) -> dict[str, Plot]:
    """Two plots for the channels of a unit: over the long run, and every sample of the last moments."""
    units: dict[str, list[str]] = {}
    for channel in channels:
        units.setdefault(channel.unit.symbol, []).append(channel.name)
    found: dict[str, Plot] = {}
    for unit, names in units.items():
        together = LINES if unit or len(names) > ALONE else 1
        parts = [names[start : start + together] for start in range(0, len(names), together)]
        for number, part in enumerate(parts, 1):
            lines = _values(run, part)
            of = f" {number} of {len(parts)}" if len(parts) > 1 else ""
            what = part[0] if together == 1 else f"{QUANTITIES.get(unit, OTHER)}{of}"
            name = f"{what} [{unit or '–'}]"
            both = (_trend(name, lines, by_unit=True, about_zero=False), _wave(name, lines, by_unit=True))
            found |= {plot.name: plot for plot in both}
    return found
