"""Two commissionings compared: what has changed is named, and nothing is accused that has not."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from bench.cli import cli
from bench.commission.comparison import NAMES, SECTORS, compared, read
from bench.commission.quantity import COVERAGE
from bench.errors import BenchError

UNITS = {"R_s": "Ω", "L_d": "H", "L_q": "H", "L_d_half": "H", "L_q_half": "H", "t_dead": "s", "n_p": "1",
         "psi_f": "V s", "J": "kg m2", "b": "N m s", "tau_c": "N m", "hall_delay": "s"}  # fmt: skip
MOTOR = {"R_s": 0.16, "L_d": 1.75e-4, "L_q": 1.76e-4, "L_d_half": 1.6e-4, "L_q_half": 1.7e-4, "t_dead": 1.2e-6,
         "n_p": 6.0, "psi_f": 6.5e-3, "J": 2e-4, "b": 1e-4, "tau_c": 8e-3, "hall_delay": 6e-6, "encoder_zero": 3.1,
         "hall_offset": -0.02, **{name: 0.01 * k - 0.05 for k, name in enumerate(SECTORS)}}  # fmt: skip
SD = {"R_s": 1.3e-3, "psi_f": 1.6e-3, "J": 4e-3, "b": 4e-3, "tau_c": 4e-3, "t_dead": 2.7e-3, "n_p": 1e-4,
      "hall_delay": 0.1}  # fmt: skip
"""Relative, of quantities as commissionings have them; of others 4e-3, of angles 1e-3 rad."""
WARM = 40.0


def sd_of(name: str) -> float:
    return SD.get(name, 4e-3) * MOTOR[name] if name in UNITS else 1e-3


def a_file(changes: Mapping[str, float] | None = None, rng: np.random.Generator | None = None, **more: Any) -> Any:
    """What a commissioning writes of a motor: shares by which quantities differ (angles: rad), and noise."""
    values = {}
    for name, value in MOTOR.items():
        change = (changes or {}).get(name, 0.0)
        moved = value * (1.0 + change) if name in UNITS else math.remainder(value + change, math.tau)
        noise = sd_of(name) * (0.0 if rng is None else rng.normal())
        width = COVERAGE * sd_of(name)
        values[name] = {"value": moved + noise, "unit": UNITS.get(name, "rad"), "half_width": width,
                        "absolute": moved + noise, "absolute_half_width": 3.0 * width}  # fmt: skip
    return {"drive": {"serial": "7"}, "current": 8.0, "about": {"started": "2026-01-02T03:04:05+00:00"},
            "quantities": values, **more}  # fmt: skip


ALL = {"R_s", "L_d", "L_q", "L_d_half", "L_q_half"}
CAUSES: dict[str, tuple[dict[str, float], str]] = {
    "warm": ({"R_s": 0.00393 * WARM, "psi_f": -0.0012 * WARM}, r"^resistance \+1\d %, flux -[45]\S* %: the motor is "
             r"warmer, its winding by about (39|40|41) K"),
    "warm, ferrite": ({"R_s": 0.00393 * WARM, "psi_f": -0.0019 * WARM}, "the motor is warmer"),
    "cold": ({"R_s": -0.00393 * WARM, "psi_f": 0.0012 * WARM}, r"the motor is colder, .* by about (39|40|41) K"),
    "warm and demagnetised": ({"R_s": 0.00393 * WARM, "psi_f": -0.2}, "more than warmth does"),
    "demagnetised": ({"psi_f": -0.05}, "demagnetised in part, unless they are still warm"),
    "stronger": ({"psi_f": 0.05}, "cannot tell"),
    "contact or warm": ({"R_s": 0.1}, r"2\d K warmer, or a contact"),
    "contact": ({"R_s": 0.8}, "look for a contact"),
    "both up": ({"R_s": 0.1, "psi_f": 0.05}, "cannot tell"),
    "volts": (dict.fromkeys([*ALL, "psi_f", "J", "b", "tau_c"], 0.04), "by another gain: .*voltmeter"),
    "amperes": (dict.fromkeys(ALL, -0.04) | dict.fromkeys(["J", "b", "tau_c"], 1.0 / 0.96 - 1.0), "gain: .*ammeter"),
    "bearing": ({"tau_c": 0.5}, "bearings, a seal, colder grease, or something that drags"),
    "run in": ({"b": -0.2, "tau_c": -0.3}, "run in, or warmer grease"),
    "attached": ({"J": 1.0}, "something is attached now"),
    "ring": ({"hall_offset": 0.1}, r"Hall ring by (5.\d|6) deg \(electrical\): it has slipped"),
    "one edge": ({"edge_up_3": -0.05}, r"^1 of 12 Hall edges have moved, by -(2.\d|3|3.\d) deg"),
    "encoder": ({"encoder_zero": 0.3}, "encoder's zero by 17 deg"),
    "power stage": ({"t_dead": 0.3}, r"dead time 1.[12]\d* us, now 1.5\d+ us: another power stage"),
    "turns": ({"L_d": -0.1, "L_d_half": -0.1, "L_q": -0.1, "L_q_half": -0.1}, "turns that are shorted"),
    "motor": ({"n_p": 1.0 / 6.0, "R_s": 1.0}, "^7 pole pairs, and 6 before: it is another motor"),
}  # fmt: skip


@pytest.mark.parametrize(("changes", "words"), CAUSES.values(), ids=CAUSES)
def test_each_cause_is_named_and_no_other(changes: dict[str, float], words: str) -> None:
    """In twenty pairs that have noise of their own; what did not change is never said to."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        found = compared(a_file(rng=rng), a_file(changes, rng))
        said = [each for each in found.words if "but barely" not in each]
        assert any(re.search(words, each) for each in said), found.words
        assert len(said) == 1, said


def test_what_a_gain_does_not_explain_is_told_beside_it() -> None:
    volts = CAUSES["volts"][0]
    gain, attached = compared(a_file(), a_file({**volts, "J": 0.5})).words
    assert "another gain" in gain
    assert attached.startswith("inertia +50 %: something is attached now")


@pytest.mark.parametrize(("width", "words"), [(1.2, "the flux has barely changed"), (0.0, "the flux has not changed")])
def test_what_has_barely_changed_is_not_said_to_be_as_it_was(width: float, words: str) -> None:
    moved = -2.0 * width * COVERAGE * SD["psi_f"]
    assert f"resistance +10 %, and {words}" in compared(a_file(), a_file({"R_s": 0.1, "psi_f": moved})).words[0]


def test_nothing_is_accused_where_nothing_has_changed() -> None:
    """A thousand pairs of commissionings of one motor, with noise as large as they say."""
    rng = np.random.default_rng(1)
    said = [words for _ in range(1000) for words in compared(a_file(rng=rng), a_file(rng=rng)).words]
    accusing = [
        words for words in said if "but barely" not in words and words != "nothing has changed beyond both intervals"
    ]
    assert len(accusing) <= 4, accusing  # 26 quantities beyond 4.2 standard deviations: 0.7 expected


@pytest.mark.parametrize("kelvin", [5.0, 15.0, 40.0, 80.0])
@pytest.mark.parametrize("magnet", [0.0004, 0.0011, 0.0019])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_motor_that_is_warmer_is_never_said_to_have_lost_flux(kelvin: float, magnet: float, share: float) -> None:
    """Magnets of any kind that are as warm as the winding, or less."""
    rng = np.random.default_rng(2)
    for _ in range(20):
        found = compared(a_file(rng=rng), a_file({"R_s": 0.00393 * kelvin, "psi_f": -magnet * share * kelvin}, rng))
        assert not any("demagnetised" in words or "lost" in words for words in found.words), found.words


def test_every_quantity_that_is_beyond_both_intervals_is_in_the_table() -> None:
    for name in NAMES:
        width = 2.0 * COVERAGE * sd_of(name)
        share = width / MOTOR[name] if name in UNITS else width
        for times, beyond in ((0.98, False), (1.02, True), (-1.02, True), (-0.98, False)):
            found = compared(a_file(), a_file({name: times * share}))
            assert [each for each, change in found.changes.items() if change.beyond] == [name] * beyond, (name, times)
            shown = [row for row in found.rows if row[-1] == "yes"]
            assert len(shown) == beyond


def test_of_another_drive_absolute_values_are_compared() -> None:
    new = a_file({"R_s": 0.02}, drive={"serial": "8"})
    found = compared(a_file(), new)
    assert "another drive" in found.words[0]
    assert found.changes["R_s"].width == pytest.approx(6.0 * COVERAGE * sd_of("R_s"))
    assert compared(a_file(), a_file({"R_s": 0.02})).changes["R_s"].width == pytest.approx(2 * COVERAGE * sd_of("R_s"))


def test_inductances_beside_another_current_are_not_compared() -> None:
    found = compared(a_file(), a_file(current=4.0))
    assert not {"L_d_half", "L_q_half"} & set(found.changes)
    assert "L_d" in found.changes


def test_what_one_of_them_has_not_is_left_out() -> None:
    new = a_file()
    new["quantities"] = {"R_s": new["quantities"]["R_s"]}
    assert set(compared(a_file(), new).changes) == {"R_s"}
    new["quantities"] = {}
    assert compared(a_file(), new).words == ("the two have no quantity in common that is compared",)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"quantities": {"R_s": 1}, "drive": {}}', '{"quantities": {}}', "R = 1"]
)
def test_what_is_no_commissioning_is_told(tmp_path: Path, text: str) -> None:
    (file := tmp_path / "x.json").write_text(text)
    with pytest.raises(BenchError, match=r"x\.json is not what bench commission writes"):
        read(file)
    with pytest.raises(BenchError, match=r"y\.json cannot be read"):
        read(tmp_path / "y.json")


def test_a_quantity_without_an_interval_is_left_out(tmp_path: Path) -> None:
    """JSON has no infinity: null is in its place."""
    data = a_file()
    data["quantities"]["R_s"]["half_width"] = None
    (file := tmp_path / "x.json").write_text(json.dumps(data))
    assert set(NAMES) - set(compared(read(file), a_file()).changes) == {"R_s"}


# -- on the command line --------------------------------------------------------------------------------------------


def invoked(*arguments: object) -> Result:
    return CliRunner().invoke(cli, ["commission", *map(str, arguments)])


def test_two_files_are_compared_without_a_drive(tmp_path: Path) -> None:
    old, new, out = (tmp_path / f"{name}.json" for name in ("old", "new", "out"))
    old.write_text(json.dumps(a_file()))
    new.write_text(json.dumps(a_file({"R_s": 0.1572, "psi_f": -0.05})))
    ended = invoked("--compare", old, "--compare", new, "--json", out)
    assert ended.exit_code == 0, ended.output
    assert "the motor is warmer, its winding by about 40 K" in ended.stdout
    assert json.loads(out.read_text())["changes"]["R_s"]["beyond"]
    ended = invoked("--compare", old, "--compare", new, "--compare", new)
    assert ended.exit_code == 2
    assert "more than twice" in ended.output
    ended = invoked("--compare", old, "--compare", new, "--report", tmp_path / "report")
    assert "-o and --report have nothing to write" in ended.output
    ended = invoked("sim", "--compare", old, "--json", old, "--overwrite")
    assert ended.exit_code == 2
    assert "is also an input" in ended.output
    assert "cannot be read" in str(invoked("sim", "--compare", tmp_path / "none.json").exception)


@pytest.mark.long("two commissionings of the windings")
def test_a_run_is_compared_with_the_one_before(tmp_path: Path) -> None:
    """The same simulated motor, and one whose winding is 30 K warmer: by the copper's law, and by nothing else."""
    old = tmp_path / "old.json"
    (warm := tmp_path / "warm.toml").write_text(f"[motor]\nR_s = {0.158 * (1.0 + 0.00393 * 30.0)}\n")
    assert invoked("sim", "--step", "r", "--json", old).exit_code == 0
    new = tmp_path / "new.json"
    ended = invoked("sim", "--step", "r", "--config", warm, "--compare", old, "--json", new)
    assert ended.exit_code == 0, ended.output
    told = json.loads(new.read_text())["comparison"]
    assert told["changes"]["R_s"]["beyond"]
    assert all(words in ended.stdout for words in told["words"])
    assert "resistance +12 %; the flux was not compared: a winding that is 30 K warmer, or a contact" in ended.stdout
    again = invoked("sim", "--step", "r", "--compare", old)
    assert "nothing has changed beyond both intervals" in again.stdout


SHAFT = "[mechanics]\nJ = 2e-4\nb = 1e-4\ntau_coulomb = 5e-3\n"
"""That of the default, which would else follow from the flux."""


@pytest.mark.campaign("commission")
@pytest.mark.long("three whole commissionings")
def test_a_motor_in_a_warm_room_is_warmer_and_one_that_lost_flux_is_not(tmp_path: Path) -> None:
    """By the plant's own laws of copper and magnets; then its magnets are weaker in the same room."""
    old = tmp_path / "old.json"
    warming = "R_th_winding = 1.0\nmagnet = -0.0011\nambient = "
    configs = {
        "cool": f"[thermal]\n{warming}20.0\n",
        "warm": f"[thermal]\n{warming}50.0\n",
        "weak": f"[thermal]\n{warming}20.0\n[motor]\npsi_f = 6.2e-3\n{SHAFT}",
    }
    for name, text in configs.items():
        (tmp_path / f"{name}.toml").write_text(text)
    assert invoked("sim", "--config", tmp_path / "cool.toml", "--json", old).exit_code == 0
    warm, weak = (
        invoked("sim", "--config", tmp_path / f"{name}.toml", "--compare", old).stdout for name in ("warm", "weak")
    )
    assert re.search(r"the motor is warmer, its winding by about (29|30|31) K, and its magnets are too", warm), warm
    assert "demagnetised" not in warm
    assert re.search(r"flux -5.3 %, and the resistance has not changed: the magnets are demagnetised in part", weak), (
        weak
    )
    assert not re.search("warmer|bearings|slipped|attached|another motor", weak), weak
