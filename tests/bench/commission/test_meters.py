"""A voltmeter and an ammeter beside a simulated drive whose converters are wrong: what is absolute then."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from click.testing import CliRunner
from plant_watch import PlantWatch
from test_commission_command import DEAD, PSI, J, L, R, run_on

from bench.cli import cli
from bench.commission.command import Options, commission
from bench.commission.commissioned import Commissioned
from bench.commission.meters import Ammeter, Reading, by_ammeter, by_voltmeter
from bench.commission.quantity import USUAL, Converters, Quantity
from bench.errors import BenchError
from tests.bench.virtual_run import TARGET, RecordingScreen, WatchedLink, never_armed, simulated

U = 24.0
"""V, of the simulated bench; nothing loads it at rest."""


def measured_with(
    gains: tuple[float, float, float], link: float, steps: tuple[str, ...] | None = ("r",), *,
    ammeter: Ammeter | None = None, off: float = 1.0, **options: Any,
) -> tuple[Commissioned, WatchedLink]:  # fmt: skip
    """A commissioning of a drive with such errors of its gains; an ammeter reads what the plant has, times `off`."""
    device = simulated(link_sensor__gain_error=link, current_sensor__gain_error=list(gains))  # type: ignore[arg-type]
    wire, watch, shown = WatchedLink(device), PlantWatch(device), [math.nan]
    if ammeter is not None:
        options["ammeter"] = replace(ammeter, read=lambda words: shown[0])

    @contextmanager
    def ask(words: str) -> Iterator[Callable[[float], bool]]:
        assert ammeter is not None
        assert words == f"read the ammeter in phase {ammeter.phase}, about 3 A"
        assert device.bench.outputs_on
        shown[0] = off * watch.phase(ammeter.phase)
        yield lambda timeout: True

    given = Options(TARGET, steps=steps, current_a=6.0, speed_rpm=3000.0, **options)
    with patch("bench.commission.command.open_target", lambda *_: wire):
        return commission(given, RecordingScreen(), None, ask), wire


# -- by formula -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("volts", "amperes"), [(1.0, -1.0), (1.0, 0.0), (1.0, 1.0), (0.0, 0.0), (0.0, 1.0)])
def test_absolute_values_and_intervals_are_those_of_drives_whose_gains_were_measured(
    volts: float, amperes: float
) -> None:
    """Truth is inside 95 times in 100, whatever the gains of the drives are: only the instruments count."""
    rng, truth, inside, n = np.random.default_rng(8), 0.2, 0, 4000
    for _ in range(n):
        g_u, g_i, e_u, e_i = 1.0 + rng.normal(0, [0.03, 0.03, 1e-3, 2e-3])
        own = truth * g_u**volts * g_i**amperes + rng.normal(0, 3e-4)
        known = Converters(1e-3, volts_gain=g_u * e_u, amperes_gain=g_i * e_i, measured_amperes=2e-3)
        quantity = Quantity("R_s", "Ω", own, {"noise": 3e-4}, volts, amperes)
        inside += abs(quantity.absolute_value(known) - truth) < quantity.absolute_half_width(known)
        assert quantity.half_width == pytest.approx(1.96 * 3e-4, rel=1e-4)
    assert inside / n == pytest.approx(0.95, abs=0.015)


@pytest.mark.parametrize("by", [by_voltmeter, by_ammeter])
@pytest.mark.parametrize(
    ("gain", "accuracy", "counts", "words"),
    [(1.004, 1e-3, True, ""), (1.02, 5e-3, True, "more than is usual"), (1.003, 0.03, False, "they agree"),
     (0.9, 0.03, True, "more than is usual")],
)  # fmt: skip
def test_a_reading_counts_where_it_is_better_or_contradicts(
    by: Callable[..., tuple[Converters, list[str]]], gain: float, accuracy: float, counts: bool, words: str
) -> None:
    known, remarks = by("x", gain * 20.0, 0.0, Reading(20.0, accuracy), USUAL)
    assert (known != USUAL) == counts
    assert words in " ".join(remarks)
    assert bool(remarks) == bool(words)
    if counts:
        mine = (known.volts, known.volts_gain) if by is by_voltmeter else (known.common_amperes, known.amperes_gain)
        assert mine == pytest.approx((accuracy / math.sqrt(3.0), gain))


# -- on simulated drives --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("link", [0.0, 0.021, -0.03])
def test_a_voltmeter_tells_volts_and_leaves_the_drives_own_alone(link: float) -> None:
    done, _ = measured_with((0.0, 0.0, 0.0), link, voltmeter=Reading(U, 1e-3))
    found, known = done.found["R_s"], done.converters
    assert known.volts_gain == pytest.approx(1.0 + link, rel=1e-4)
    assert found.covers(R * (1.0 + link))
    assert abs(found.absolute_value(known) - R) < found.absolute_half_width(known)
    assert found.absolute(known) < 0.7 * found.absolute(USUAL)
    assert any("voltmeter reads 24 V" in words for words in done.remarks) == (abs(link) > 0.01)


@pytest.mark.parametrize("phase", ["a", "b", "c"])
def test_both_instruments_tell_the_truth_of_a_drive_that_is_wrong_in_everything(phase: str) -> None:
    gains, link = (0.031, 0.018, 0.014), -0.025
    ammeter = Ammeter(phase, 2e-3, lambda words: math.nan)
    done, wire = measured_with(gains, link, voltmeter=Reading(U * 1.0004, 1e-3), ammeter=ammeter, off=-0.999)
    known, found = done.converters, done.found["R_s"]
    assert known.amperes_gain == pytest.approx(1.0 + np.mean(gains), rel=2e-3)
    own = R * (1.0 + link) / (1.0 + np.mean(gains))
    assert found.covers(own)
    assert abs(found.absolute_value(known) - R) < found.absolute_half_width(known)
    assert abs(own - R) > 4.0 * found.absolute_half_width(known)  # which it would not have told by itself
    assert list(done.outcomes) == ["offsets", "first-current", "resistance", "ammeter"]
    text, _ = done.as_toml()
    assert tomllib.loads(text)["parameters"]["R_s_hat"] == pytest.approx(found.value, rel=1e-6)
    assert f"{found.absolute_value(known):.5g} +- " in text
    told = done.as_json()
    assert told["converters"]["volts_gain"] == known.volts_gain
    assert told["quantities"]["R_s"]["absolute"] == found.absolute_value(known)
    assert not wire.device.bench.outputs_on


@pytest.mark.campaign("commission")
@pytest.mark.long("a whole commissioning")
def test_all_absolute_values_are_those_of_the_plant() -> None:
    """Whatever the powers are with which volts and amperes enter: 2.5 % too few of those, 2.1 % too many of these."""
    ammeter = Ammeter("c", 2e-3, lambda words: math.nan)
    done, _ = measured_with((0.031, 0.018, 0.014), -0.025, None, voltmeter=Reading(U, 1e-3), ammeter=ammeter)
    assert not done.refused
    truth = {"R_s": R, "L_d": L, "L_q": L, "psi_f": PSI, "J": J, "b": 1e-4, "tau_c": 5e-3, "t_dead": DEAD}
    for name, value in truth.items():
        found = done.found[name]
        assert abs(found.absolute_value(done.converters) - value) < 1.3 * found.absolute_half_width(done.converters), (
            name
        )
    far = [name for name, value in truth.items() if abs(done.found[name].value / value - 1.0) > 0.015]
    assert {"R_s", "L_d", "L_q", "psi_f"} <= set(far)


def test_what_an_instrument_cannot_have_read_is_told_before_anything_flows() -> None:
    done, wire = measured_with((0.0, 0.0, 0.0), 0.0, voltmeter=Reading(12.0, 1e-3))
    assert "the voltmeter reads 12 V, the drive 24 V: they do not measure the same thing" in done.refused["offsets"]
    assert never_armed(wire)


@pytest.mark.long("windings, beside an ammeter")
@pytest.mark.parametrize(("off", "words"), [(0.0, "it is not in phase a"), (1.4, "they do not measure the same thing")])
def test_an_ammeter_elsewhere_is_told_and_the_rest_stands(off: float, words: str) -> None:
    ammeter = Ammeter("a", 1e-3, lambda words: math.nan)
    done, _ = measured_with((0.0, 0.0, 0.0), 0.0, ("l",), ammeter=ammeter, off=off)
    assert words in done.refused["ammeter"]
    assert done.converters == USUAL
    assert "L_d" in done.found


def test_an_ammeter_needs_somebody_who_reads_it() -> None:
    link = WatchedLink(simulated())
    with pytest.raises(BenchError, match="an ammeter needs somebody at a terminal"):
        run_on(link, ammeter=Ammeter("a", 0.01, lambda words: 1.0))
    assert never_armed(link)


# -- on the command line --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["--voltmeter", "24:0.1"], "has no accuracy in percent"), (["--voltmeter", "-3"], "must be above 0"),
     (["--voltmeter", "24:x%"], "'x' is not a finite number"), (["--voltmeter", "24:0%"], "must be above 0"),
     (["--ammeter", "d"], "'d' is no phase"), (["--ammeter", "a"], "an ammeter needs somebody")],
)  # fmt: skip
def test_what_is_no_reading_is_told(arguments: list[str], words: str) -> None:
    ended = CliRunner().invoke(cli, ["commission", "sim", "--step", "offsets", *arguments])
    assert ended.exit_code == 2 or isinstance(ended.exception, BenchError)
    assert words in ended.output or words in str(ended.exception)


def test_the_table_has_absolute_values_where_a_voltmeter_tells_them(tmp_path: Path) -> None:
    (config := tmp_path / "drive.toml").write_text("[link_sensor]\ngain_error = 0.02\n")
    arguments = ["commission", "sim", "--config", str(config), "--step", "offsets"]
    without, beside = (CliRunner().invoke(cli, [*arguments, *more]) for more in ([], ["--voltmeter", "24:0.1%"]))
    assert re.search(r"^DC link voltage +24.48 V .*\+- 0.98 %", without.stdout, re.MULTILINE)
    assert re.search(r"^DC link voltage +24.48 V .* 24 V +\+- 0.11 %", beside.stdout, re.MULTILINE)
    assert "the drive 24.48 V, +2 %: more than is usual" in beside.output
