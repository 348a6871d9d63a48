"""Every channel has a plot, whoever named it; nothing is plotted that a run cannot fill, or under a unit it has not."""

from __future__ import annotations

import math

import pytest
import synthetic
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import named

from bench.view.plane import Plane
from bench.view.plots import left_out, plots, trend_lines
from bench.view.schema import PLANE
from protocol.descriptor import Channel
from protocol.signals import Flag, RawType, Unit

NAMES = st.text(min_size=1, max_size=16)
CHANNELS = st.lists(
    st.builds(
        Channel,
        st.integers(1, 1000),
        NAMES | st.sampled_from([channel.name for channel in synthetic.CHANNELS]),
        st.sampled_from(Unit),
        st.sampled_from(RawType),
        st.just(1.0),
        st.sampled_from([Flag.CHANNEL | flag for flag in (Flag(0), Flag.ESTIMATE, Flag.REFERENCE, Flag.WRAPS)]),
    ),
    max_size=40,
    unique_by=lambda channel: channel.name,
)


@settings(deadline=None, max_examples=40)
@given(CHANNELS)
def test_every_channel_is_in_a_plot_with_its_unit_and_told_apart_or_is_a_word_of_states(channels: list[Channel]):
    run = synthetic.run_info(channels=tuple(channels))
    shown = plots(run)
    anywhere = {line.channel for plot in shown.values() for line in plot.lines}
    assert run.words <= {"hall", "status"}
    assert anywhere | run.words == {channel.name for channel in channels}
    for plot in shown.values():
        assert plot.lines
        assert len({line.component for line in plot.lines}) == len(plot.lines)
        assert "[" in plot.name
        if plot.by_unit:
            assert len({line.colour for line in plot.lines}) == len(plot.lines)
            assert len({next(c.unit for c in channels if c.name == line.channel) for line in plot.lines}) == 1
    bands, means = trend_lines(run)
    components = [line.component for line in (*bands, *means)]
    assert len(set(components)) == len(components)


def test_a_drive_of_a_vocabulary_of_its_own() -> None:
    flags = Flag.CHANNEL
    channels = (
        Channel(1, "v_bus", Unit.V, RawType.U16, 0.01, flags),
        Channel(2, "w_target", Unit.RAD_PER_S, RawType.I16, 0.1, flags),
        Channel(3, "pos_e", Unit.RAD, RawType.I16, 1e-4, flags),
        Channel(4, "temp_fet", Unit.NONE, RawType.F32, 1.0, flags),
        Channel(5, "w_meas", Unit.RAD_PER_S, RawType.I16, 0.1, flags),
        Channel(6, "torque", Unit.NM, RawType.I16, 0.1, flags),
    )
    run = synthetic.run_info(channels=channels, parameters={"kp_w": 1.0}, identity={"features": []})
    shown = [(plot.name, [line.name for line in plot.lines]) for plot in plots(run).values()]
    lines = [
        ("Voltages [V]", ["v_bus"]),
        ("Speeds [rad/s]", ["w_target", "w_meas"]),
        ("Angles [rad]", ["pos_e"]),
        ("temp_fet [–]", ["temp_fet"]),
        ("Torques [N·m]", ["torque"]),
    ]
    assert shown == [(f"{name}, {span}", of) for name, of in lines for span in ("min/max, last 25 s", "last 0.2 s")]
    assert not run.hall
    assert left_out(run) == [
        "position error: needs a position flagged REFERENCE",
        "position error: needs a position flagged ESTIMATE",
        "Hall sensors: needs the channel hall, or edges",
    ]
    assert Plane(run).contents == ""


def test_hundreds_of_channels_are_spread_over_plots_of_lines_that_differ_in_colour() -> None:
    units = [Unit.V, *[Unit.A] * 6] * 100
    channels = tuple(Channel(k, f"x{k}", unit, RawType.U8, 1.0, Flag.CHANNEL) for k, unit in enumerate(units))
    shown = list(plots(synthetic.run_info(channels=channels)).values())
    assert max(len(plot.lines) for plot in shown) <= 10
    assert [plot.name for plot in shown if len({line.colour for line in plot.lines}) < len(plot.lines)] == []
    assert shown[2].name.startswith("Voltages 2 of ")


def test_channels_without_a_unit_are_compared_only_where_there_are_many() -> None:
    for count, lines in ((16, {1}), (17, {8, 1})):
        channels = tuple(Channel(k, f"x{k}", Unit.NONE, RawType.F32, 1.0, Flag.CHANNEL) for k in range(count))
        shown = plots(synthetic.run_info(channels=channels)).values()
        assert {len(plot.lines) for plot in shown} == lines
        assert len({plot.name for plot in shown}) == len(shown) == 2 * (16 if count == 16 else 3)


@pytest.mark.parametrize(
    ("n_p", "unit", "factor"),
    [(6.0, "r/min", 60 / (2 * math.pi) / 6), (None, "rad/s", 1.0)],
)
def test_speeds_are_labelled_what_they_are(n_p: float | None, unit: str, factor: float) -> None:
    run = synthetic.run_info(
        channels=named("omega_enc", "omega_vt", "omega_ref"), parameters={} if n_p is None else {"n_p": n_p}
    )
    speed = plots(run)["speed"]
    kind = "mechanical" if unit == "r/min" else "electrical"
    assert speed.name.startswith(f"Speed, {kind} [{unit}]")
    lines = [(name, pytest.approx(factor)) for name in ("vector tracking", "encoder", "reference")]
    assert [(line.name, line.factor) for line in speed.lines] == lines
    assert any("n_p" in why for why in left_out(run)) == (n_p is None)


@pytest.mark.parametrize(("names", "title"), [
    (("theta_vt",), "rotor axes"),
    (("i_a", "i_b"), ""),
    (("i_a", "i_b", "i_c", "u_alpha", "u_beta"), "current [A], voltage [V]"),
    (("e_alpha", "e_beta", "theta_enc"), "rotor axes, back-EMF [V]"),
])  # fmt: skip
def test_the_stator_plane_tells_what_it_shows(names: tuple[str, ...], title: str) -> None:
    assert Plane(synthetic.run_info(channels=named(*names))).contents == title


def test_without_a_reference_there_is_no_position_error() -> None:
    assert not {"error", "error_trend"} & set(plots(synthetic.run_info(channels=named("theta_vt", "theta_avg"))))


def test_a_known_name_with_another_unit_is_plotted_by_its_unit() -> None:
    volts = Channel(1, "i_d", Unit.V, RawType.I16, 1.0, Flag.CHANNEL)
    word = Channel(2, "status", Unit.NONE, RawType.F32, 1.0, Flag.CHANNEL)
    run = synthetic.run_info(channels=(volts, word))
    assert [plot.name.split(",")[0] for plot in plots(run).values()][::2] == ["Voltages [V]", "status [–]"]
    assert run.words == set()


def test_an_angle_that_does_not_wrap_is_not_cut_off() -> None:
    many = Channel(1, "turns", Unit.RAD, RawType.F32, 1.0, Flag.CHANNEL | Flag.REFERENCE)
    assert plots(synthetic.run_info(channels=(many,)))["position"].y_range is None
    assert plots(synthetic.run_info(channels=named("theta_enc")))["position"].y_range == (-3.3, 3.3)


def test_the_voltage_vector_is_compared_with_the_bus_where_there_is_both() -> None:
    names = {"u_dc": ["u_dc"], "u_alpha": None}
    for name, lines in names.items():
        bus = plots(synthetic.run_info(channels=named(name))).get("bus")
        assert (bus and [line.name for line in bus.lines]) == lines
    bus = plots(synthetic.run_info(channels=named("u_dc", "u_alpha", "u_beta")))["bus"]
    assert [line.name for line in bus.lines] == ["u_dc", "limit u_dc/√3", "|u|"]


@pytest.mark.parametrize("ring_deg", [None, 30.0, -75.0])
def test_the_rays_of_the_plane_are_where_the_drive_has_its_edges(ring_deg: float | None) -> None:
    parameters = {} if ring_deg is None else {"hall_offset": math.radians(ring_deg)}
    drawn = dict(Plane(synthetic.run_info(parameters=parameters)).frame())
    _, *rays = drawn[f"{PLANE}/lines"].strips.as_arrow_array().to_pylist()
    angles = [math.degrees(math.atan2(-y, x)) % 360.0 for _, (x, y) in rays]
    assert angles == pytest.approx([((ring_deg or 0.0) + 60.0 * k) % 360.0 for k in range(6)], abs=1e-3)
