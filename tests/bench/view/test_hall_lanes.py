"""The Hall view shows the present code at every moment: turning, resting, never turned, with and without edges."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest
import synthetic

from bench.record.reader import Run
from bench.view import schema
from tests.choice import sampled

SENSORS = {code: [f"{code >> bit & 1}" for bit in range(3)] for code in range(8)}
WINDOW = 0.1  # s that the view shows


def record(path: Path, made: synthetic.SyntheticRun, edges: bool = True, **changes: object) -> dict[str, np.ndarray]:
    """What the lanes of a recording of `made` hold: times in s, and the sensors' states."""
    chunks = made.chunks() if edges else made.sample_chunks()
    return lanes(synthetic.recorded(path, *chunks, channels=made.config.channels, **changes))


def lanes(path: Path) -> dict[str, np.ndarray]:
    rows = synthetic.column(path, schema.HALL_LANES, "StateChange:state")
    return {"t": np.array([at for at, _ in rows]) / 1e9, "words": np.array([words for _, words in rows])}


def truth(made: synthetic.SyntheticRun, t: np.ndarray) -> list[list[str]]:
    """The sensors at times `t` by the edges that the run was made from."""
    passed = np.searchsorted(made.edge_tick, np.rint(t * synthetic.TICK_HZ), side="right")
    return [SENSORS[int(synthetic.CODES[k % 6])] for k in passed]


def shown_at(found: dict[str, np.ndarray], t: np.ndarray) -> list[list[str]]:
    """What a view at times `t` shows: the newest row, which must lie within its window."""
    newest = np.searchsorted(found["t"], t, side="right") - 1
    assert (newest >= 0).all()
    assert (t - found["t"][newest]).max() <= WINDOW + 1e-9
    return found["words"][newest, :3].tolist()


# A shaft that rests has one sector; 8 r/min are 4.8 edges a second; 600 r/min are 360.
@pytest.mark.parametrize(
    ("rpm", "edges"), sampled("codes", product([0.0, 8.0, 600.0], [True, False]), 2, campaign="viewer")
)
def test_the_present_code_is_shown_from_the_first_sample_on(tmp_path: Path, rpm: float, edges: bool) -> None:
    made = synthetic.SyntheticRun(2.0, rpm)
    found = record(tmp_path / "a.run", made, edges)
    samples = made.tick / synthetic.TICK_HZ
    moments = samples[:: 163 if edges else 1]
    assert (shown_at(found, moments), found["t"][0]) == (truth(made, moments), pytest.approx(samples[0]))
    assert len(found["t"]) <= len(made.edge_tick) + 2.0 / 0.05 + 1


@pytest.mark.parametrize("rpm", [0.0, 8.0, 600.0])
def test_without_the_channel_the_last_edge_tells_the_code(tmp_path: Path, rpm: float) -> None:
    made = synthetic.SyntheticRun(2.0, rpm, config=synthetic.config(synthetic.named("i_a", "u_dc")))
    found = record(tmp_path / "a.run", made)
    moments = made.tick[::163] / synthetic.TICK_HZ
    turned = moments >= (made.edge_tick[0] / synthetic.TICK_HZ if len(made.edge_tick) else np.inf)
    shown = shown_at(found, moments)
    assert [words for words, has in zip(shown, turned, strict=True) if has] == truth(made, moments[turned])
    assert all(words == ["?", "?", "?"] for words, has in zip(shown, turned, strict=True) if not has)


def test_a_drive_without_hall_channel_and_edges_has_no_lanes(tmp_path: Path) -> None:
    made = synthetic.SyntheticRun(0.5, config=synthetic.config(synthetic.named("i_a")))
    assert len(record(tmp_path / "a.run", made, edges=False, identity={"features": ["commit"]})["t"]) == 0


def test_after_a_reboot_the_code_is_shown_at_once(tmp_path: Path) -> None:
    first, second = synthetic.SyntheticRun(0.5, 600.0, start=100.0), synthetic.SyntheticRun(0.5, 0.0, start=1.0)
    found = lanes(synthetic.recorded(tmp_path / "a.run", *first.chunks(), *second.chunks()))
    moments = second.tick[::163] / synthetic.TICK_HZ
    assert shown_at(found, moments) == truth(second, moments)


def test_while_it_turns_the_rows_are_the_edges_to_the_tick(tmp_path: Path) -> None:
    made = synthetic.SyntheticRun(1.0, 3000.0)
    found = record(tmp_path / "a.run", made)
    turning = found["t"] > 100.5
    np.testing.assert_array_equal(
        np.rint(found["t"][turning] * synthetic.TICK_HZ), made.edge_tick[made.edge_tick > 100.5 * synthetic.TICK_HZ]
    )
    assert len(Run(tmp_path / "a.run").edges) == len(made.edge_tick)
