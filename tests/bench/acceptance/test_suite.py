"""The shipped suite on an untouched drive: it passes, with other noise too, and is the same in several processes.

That it fails where something is wrong is for `test_sabotage`. Nothing here knows a limit or a value.
"""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from unittest.mock import patch
from zlib import crc32

from accepting import Accepting

from bench.acceptance.results import Verdict

MAP = "fig13_thd_map"  # the longest, of which each point is as quiet as the next
SOME = "hall_wire_broken or hall_glitches or torque_constant or fig09"  # noise, draws of the sensors, parameters


def test_an_untouched_drive_passes_everything_and_everything_is_explained(accepting: Accepting) -> None:
    run = accepting()
    assert run.code == 0
    assert {test.verdict for test in run.result.tests} == {Verdict.PASS}
    assert {m.verdict for m in run.result.measurements} == {Verdict.PASS}

    assert [name for name, often in Counter(test.name for test in run.result.tests).items() if often > 1] == []
    assert [name for name, often in Counter(m.name for m in run.result.measurements).items() if often > 1] == []
    assert [test.name for test in run.result.tests if not test.title] == []
    assert [m.name for m in run.result.measurements if not m.limits.about] == []
    bounds = [(m.name, bound) for m in run.result.measurements for bound in (m.limits.lo, m.limits.hi)]
    assert [name for name, bound in bounds if bound is not None and not math.isfinite(bound)] == []
    unlimited = {m.name for m in run.result.measurements if m.limits.lo is None and m.limits.hi is None}
    assert unlimited == {"back_emf_and_encoder.psi_f"}  # its deviation from the drive's own has limits

    some = accepting(keyword=SOME, jobs=2).measured
    assert len(some) > 30
    assert repr(some) == repr({name: run.measured[name] for name in some})


def test_an_untouched_drive_passes_whatever_the_noise(accepting: Accepting) -> None:
    seeds = []

    def seed_of(test: bytes) -> int:
        seeds.append(crc32(test, 1))
        return seeds[-1]

    with patch("bench.rig.connection.crc32", seed_of):
        run = accepting(keyword=f"not {MAP}")
    assert {name: m.value for name, m in run.measured.items() if m.verdict is not Verdict.PASS} == {}
    assert run.code == 0
    assert len(set(seeds)) > len(run.tests) > 20  # one more to try whether the drive can be made


def test_an_encoder_that_is_late_is_the_benchs_error_and_hall_sensors_that_are_late_fail(
    accepting: Accepting, tmp_path: Path
) -> None:
    runs = {}
    for name in ("encoder", "hall"):
        config = tmp_path / f"{name}.toml"
        config.write_text(f"[{name}]\nlatency = 1e-4\n")
        runs[name] = accepting(keyword="angles_are_of_one_time", config=config)
    (late,) = runs["encoder"].result.tests
    assert late.verdict is Verdict.ERROR
    assert "the encoder is 10" in late.why
    assert "back-EMF" in late.why
    measured = runs["hall"].measured
    assert measured["angles_are_of_one_time.encoder"].verdict is Verdict.PASS
    assert measured["angles_are_of_one_time.hall"].verdict is Verdict.FAIL
