"""Rows of studies that no drive has run: whose yields, distances and indices are known by formula."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from bench.signal.limits import Limits
from bench.study.answers import About
from bench.study.rows import Rows


def rows_of(
    inputs: Mapping[str, np.ndarray],
    measured: Mapping[str, np.ndarray],
    limits: Sequence[Limits] = (),
    designs: Sequence[str] = ("a",),
    verdicts: Mapping[str, np.ndarray] | None = None,
) -> Rows:
    """`inputs` (n,), `measured` and `verdicts` (n, repetitions, designs); a test passes within all its limits."""
    (shape,) = {np.shape(column) for column in (*measured.values(), *(verdicts or {}).values())}
    n, repetitions, kinds = shape
    sample, repetition, design = (axis.ravel() for axis in np.indices(shape))
    by_name = {one.name: one for one in limits}
    found = {name: column.astype(str).ravel() for name, column in (verdicts or {}).items()}
    for test in dict.fromkeys(name.partition(".")[0] for name in by_name):
        if test not in found:
            mine = [name for name in by_name if name.startswith(f"{test}.")]
            within = [[by_name[name].allow(value) for value in measured[name].ravel()] for name in mine]
            found[test] = np.where(np.all(within, axis=0), "PASS", "FAIL")
    return Rows(
        (sample * repetitions + repetition) * kinds + design, sample, repetition, design, tuple(designs),
        {name: np.repeat(column, repetitions * kinds) for name, column in inputs.items()},
        {name: column.ravel().astype(float) for name, column in measured.items()},
        found, by_name, np.ones(n * repetitions * kinds),
    )  # fmt: skip


def picked(rows: Rows, at: np.ndarray) -> Rows:
    """Only these rows, in this order."""
    return Rows(
        rows.row[at], rows.sample[at], rows.repetition[at], rows.design[at], rows.designs,
        *({name: column[at] for name, column in of.items()} for of in (rows.inputs, rows.measured, rows.verdicts)),
        rows.limits, rows.seconds[at],
    )  # fmt: skip


def about(rows: Rows, **more: object) -> About:
    """Of these rows."""
    count = len(set(rows.sample.tolist()))
    made = About("made", (("varied", "r_s normal"),), "at random", count, "bench study replay s.toml {}".format)
    return replace(made, **more)


def motors(n: int, seed: int = 1, repetitions: int = 2) -> Rows:
    """Two designs, three tests, seven inputs of which one is constant and one twice there."""
    random = np.random.default_rng(seed)
    inputs = {
        "motor.r_s": random.normal(0.5, 0.05, n),
        "motor.l_s": random.normal(1e-3, 1e-4, n),
        "motor.psi": random.uniform(0.019, 0.021, n),
        "hall.delta_deg_1": random.normal(0, 2.0, n),
        "hall.delta_deg_2": random.normal(0, 2.0, n),
        "pwm.dead_time": np.full(n, 1e-6),
    }
    inputs["motor.l_q"] = inputs["motor.l_s"] * 1.2
    first, second = inputs["hall.delta_deg_1"], inputs["hall.delta_deg_2"]
    noise = random.normal(size=(3, n, repetitions, 2))
    std = 2.0 + 0.35 * np.abs(first)[:, None, None] + 0.15 * noise[0] + np.array([0.0, -0.4])
    mean = 0.8 * first[:, None, None] + 0.4 * second[:, None, None] + 0.3 * noise[1] + np.array([0.0, 0.1])
    rise = 40.0 + 30.0 * ((inputs["motor.r_s"] - 0.5) / 0.05)[:, None, None] * 0.2 + noise[2]
    limits = [
        Limits("steady.error_std", "deg", None, 4.0),
        Limits("steady.error_mean", "deg", -5.0, 5.0),
        Limits("step.rise", "ms", None, 60.0),
        Limits("step.dropped", "", None, 0.0),
    ]
    dropped = (np.abs(first) > 4.5)[:, None, None] * np.ones((1, repetitions, 2))
    rows = rows_of(
        inputs,
        {
            "steady.error_std": std,
            "steady.error_mean": mean,
            "step.rise": rise,
            "step.dropped": dropped,
            "step.thd": rise**2,
        },
        limits,
        ("paper", "edge_kalman"),
    )
    rows.verdicts["step"][::97] = "INVALID"
    rows.measured["step.rise"][::97] = np.nan
    return rows
