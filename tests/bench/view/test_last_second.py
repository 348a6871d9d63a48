"""The last second against what the signals were made of: offsets of edges, harmonics, errors, currents."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
import synthetic
from hall_motor import Motor, capture

from bench.view import schema
from bench.view.last_second import LastSecond
from protocol.streams import SampleChunk

CHANNELS = synthetic.named(
    "theta_enc", "theta_vt", "omega_enc", "i_a", "i_b", "i_c", "i_d", "i_q", "u_dc", "u_alpha", "u_beta"
)
CONFIG = synthetic.config(CHANNELS)
N = 16_000
T = np.arange(N) / synthetic.PWM_HZ
LATE = np.array([1.5, -3.0, 7.0, -3.5, 0.5, -2.5])  # deg, of the edges that open the sectors I to VI


def made(omega: float, edges: bool = True, ring: float = 0.0, **changed: np.ndarray) -> dict[str, object]:
    """What the last second shows of a shaft that turns at `omega` electrical rad/s, by entity: bars, or text.

    `ring`: rad by which the sensors' ring is turned, and the drive told.
    """
    theta = math.radians(30.0) + ring + omega * T
    phase = theta[:, None] - 2 * np.pi / 3 * np.arange(3)
    currents = 4.0 * np.cos(phase) + 0.4 * np.cos(5 * phase) + 0.2 * np.cos(7 * phase)
    values = dict(zip(("i_a", "i_b", "i_c"), currents.T, strict=True))
    values |= {"theta_enc": synthetic.wrap(theta), "i_d": np.full(N, -0.5), "i_q": np.full(N, 3.0)}
    values |= {"u_dc": np.full(N, 24.0), schema.U_ABS: np.full(N, 12.0 / np.sqrt(3))}
    values |= {"omega_enc": np.full(N, omega)} | changed
    errors = {"theta_vt": 2.0 + 3.0 * np.sin(2 * theta)}  # deg
    tick = np.arange(N, dtype=np.int64) * synthetic.TICKS
    parameters = {"n_p": 6.0, "hall_offset": ring} if ring else {"n_p": 6.0}
    shown = LastSecond(synthetic.run_info(channels=CHANNELS, parameters=parameters))
    if edges:
        # late in the direction of travel
        shown.edges(capture(Motor(((omega, 1.0),), delta_deg=-math.copysign(1.0, omega) * LATE)).edges)
    shown.samples(
        SampleChunk(CONFIG, np.arange(N, dtype=np.int64), tick, np.zeros(N, CONFIG.dtype), ()), values, errors
    )
    assert shown.due() == tick[-1]
    assert shown.due() is None
    found: dict[str, object] = {}
    for entity, part in shown.pictures():
        for batch in part.as_component_batches():  # type: ignore[union-attr]
            name = batch.component_descriptor().component
            if name == "BarChart:values":
                found[entity] = np.array(batch.as_arrow_array()[0]["buffer"].as_py())[:-1]
            elif name == "TextDocument:text":
                found[entity] = batch.as_arrow_array()[0].as_py()
    return found


@pytest.mark.parametrize("ring", [0.0, -1.3])
@pytest.mark.parametrize(("omega", "way"), [(628.0, "forward"), (-628.0, "reverse"), (70.0, "forward")])
def test_edges_are_late_by_what_they_were_made_late(omega: float, way: str, ring: float) -> None:
    found = made(omega, ring=ring)
    assert [entity for entity in found if entity.startswith("late/")] == [f"late/{way}"]
    np.testing.assert_allclose(found[f"late/{way}"], LATE, atol=0.05)
    words = re.findall(r"([IV]+) ([+-][0-9.]+)", str(found[schema.NUMBERS]))
    assert [float(value) for _, value in words] == pytest.approx(LATE, abs=0.06)


@pytest.mark.parametrize("omega", [30.0, 628.0, 1885.0, -628.0])
def test_harmonics_are_those_that_the_currents_have(omega: float) -> None:
    for phase in "abc":
        share = made(omega)[f"harmonics/i_{phase}"]
        wanted = np.zeros(19)
        wanted[5 - 2], wanted[7 - 2] = 10.0, 5.0
        np.testing.assert_allclose(share, wanted, atol=0.1)
    thd = 100 * np.hypot(0.1, 0.05)
    assert f"| THD i_a | {thd:.1f} % of 4 A |" in str(made(omega)[schema.NUMBERS])


def test_the_error_is_shown_where_in_the_revolution_it_is() -> None:
    bars = made(628.0)["by_angle/vector-tracking"]
    middle = np.radians(10 * np.arange(36) + 5)
    np.testing.assert_allclose(bars, 2.0 + 3.0 * np.sin(2 * middle), atol=0.1)
    text = str(made(628.0)[schema.NUMBERS])
    assert f"+2.00, {3 / np.sqrt(2):.2f}, 5.00 deg" in text
    assert "999.5 r/min, 99.95 Hz electrical" in text
    assert "| 50.0 %, max 50.0 % |" in text


def test_a_shaft_at_rest_has_no_bars_but_numbers() -> None:
    found = made(1e-9, edges=False)
    assert not [entity for entity in found if entity.startswith(("late", "harmonics", "by_angle"))]
    assert "THD i_a | undefined" in str(found[schema.NUMBERS])


def test_a_shaft_too_fast_for_the_samples_gets_no_numbers_made_of_its_angle() -> None:
    """Turning by 1.1 electrical revolutions from sample to sample it looks as if it turned by 0.1."""
    found = made(1.1 * 2 * np.pi * synthetic.PWM_HZ, edges=False)
    assert not [entity for entity in found if entity.startswith(("late", "harmonics"))]
    text = str(found[schema.NUMBERS])
    assert "the angle turns 396 deg from sample to sample" in text
    assert "mean speed" not in text


def test_a_channel_that_is_not_finite_leaves_nothing_stale_and_is_named() -> None:
    found = made(628.0, i_q=np.where(T > 0.9, np.nan, 1.0))
    assert list(found) == [schema.NUMBERS]
    assert "not a finite number: i_q" in str(found[schema.NUMBERS])
