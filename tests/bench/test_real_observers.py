"""Observers on Hall edges alone, on eight captures of real motors: figures within limits on both sides, and moteus's.

The limits are in `tables/real_observers.toml`, the table is in docs/hall.md: python docs/make_real_halls.py.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from moteus_captures import NAMES, needs_captures

from docs import make_real_halls
from tests.bench.moteus_scores import (
    METRIC,
    OBSERVERS,
    PUBLISHED,
    WORSE,
    best_published,
    figures,
    published_metric,
    read_limits,
    truth,
)

CODE_OF_SECTOR = (1, 3, 2, 6, 4, 5)
SOME = ("20250616-back-and-forth", "20250616-bnforth-highaccel")
long = pytest.mark.long("scores a capture")


def codes_of(*sectors: tuple[int, int]) -> np.ndarray:
    """Codes of (sector, samples)."""
    return np.repeat([CODE_OF_SECTOR[sector % 6] for sector, _ in sectors], [n for _, n in sectors]).astype(np.uint8)


def test_the_truth_is_that_of_the_published_test() -> None:
    """By hand: three sectors forward and two back, of 10, 20 and so on samples."""
    position, velocity, way = truth(codes_of((0, 10), (1, 20), (2, 30), (1, 40), (0, 50)))
    assert [position[k] for k in (0, 5, 10, 29)] == pytest.approx([0.0, 0.5, 1 + 1 / 21, 1 + 20 / 21])
    assert [velocity[k] for k in (5, 15)] == pytest.approx([30_000 / 9, 30_000 / 20])  # it counts from 0 at first
    assert (position[30:60] == 2).all()  # in and out over one edge: it stands
    assert not velocity[30:60].any()
    assert position[60] == pytest.approx(1 - 1 / 41)
    assert velocity[70] == pytest.approx(-30_000 / 40)
    assert (position[100:] == 0).all()  # nothing comes after it
    assert way[[5, 15, 45, 70, 120]].tolist() == [1, 1, 0, -1, 0]


@pytest.mark.parametrize("way", [1, -1])
def test_the_published_metric_of_an_angle_that_is_right_is_nothing(way: int) -> None:
    codes = codes_of(*((way * k, 25) for k in range(60)))
    position, velocity, _ = truth(codes)
    theta = (position + (0 if way > 0 else 1)) * math.pi / 3
    inner = slice(25, -25)
    found = published_metric(codes, theta, velocity * math.pi / 3)
    assert found.velocity == pytest.approx(0, abs=1e-9)
    centre = (np.floor(theta * 3 / math.pi - (1e-9 if way < 0 else -1e-9)) + 0.5) * math.pi / 3
    held = published_metric(codes, centre, 0.0 * velocity)
    assert held.position_max == pytest.approx(0.5, abs=0.05)
    assert held.position == pytest.approx(1 / 12, rel=0.1)
    assert held.velocity_max == pytest.approx(np.abs(velocity[inner]).max(), rel=0.05)


@needs_captures
@pytest.mark.parametrize("name", [*SOME, *(pytest.param(n, marks=long) for n in NAMES if n not in SOME)])
def test_figures_on_real_captures_are_within_limits_on_both_sides(name: str) -> None:
    limits = read_limits()[name]
    assert set(limits) == set(OBSERVERS)
    outside = [
        f"{observer} {key}: {value:.4g}, expected {limits[observer][key]}"
        for observer, of in figures(name).items()
        for key, value in of.items()
        if not limits[observer][key][0] <= value <= limits[observer][key][1]
    ]
    assert not outside, "\n".join(outside)


@needs_captures
@pytest.mark.parametrize("name", [*SOME, *(pytest.param(n, marks=long) for n in PUBLISHED if n not in SOME)])
def test_moteus_is_no_better_but_where_it_is_said_why(name: str) -> None:
    """Against the least of its limits over all bandwidths; no limit of the table lets a figure be better by mistake."""
    best = best_published(name)
    worse = {
        (observer, key) for observer, of in figures(name).items() for key in METRIC if of[key] > getattr(best, key)
    }
    said = {(observer, key) for of, observer, key in WORSE if of == name}
    assert worse == said


def test_a_limit_has_two_sides_about_what_is_measured() -> None:
    for name in NAMES:
        for of in read_limits()[name].values():
            for key, (lo, hi) in of.items():
                assert lo < hi
                assert key == "bias" or lo > 0
                assert hi - lo < max(0.5 * abs(hi + lo), 0.3), (name, key)


def test_the_table_in_the_docs_has_what_the_limits_are_about() -> None:
    """Both are written by one command; neither is without the other."""
    made = make_real_halls.PAGE.read_text().split(make_real_halls.BEGIN.format(make_real_halls.OBSERVERS))[1]
    name, rows = "", 0
    for line in made.split(make_real_halls.END.format(make_real_halls.OBSERVERS))[0].splitlines():
        capture, observer, *cells = [cell.strip() for cell in line.strip("|").split("|")] + [""]
        name = capture or name
        if observer not in OBSERVERS:
            continue
        for (key, (_, form)), cell in zip(make_real_halls.SCORES.items(), cells, strict=False):
            value = float(cell.replace("−", "-").partition(" ")[0])
            assert value == pytest.approx(
                sum(read_limits()[name][observer][key]) / 2, rel=1e-3, abs=10 ** -int(form[-2])
            )
        rows += 1
    assert rows == len(NAMES) * len(OBSERVERS)
