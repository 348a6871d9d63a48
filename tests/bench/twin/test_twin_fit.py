"""Twins of simulated drives: what was drawn is found within its interval, and what nothing tells is named."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from shared import once
from twin_drives import drawn, reversal, steps

import bench
from bench.errors import BenchError
from bench.record.reader import captures
from bench.record.recording import run_of
from bench.signal.position import wrap
from bench.twin.check import Checked, check
from bench.twin.directions import Equations, solved
from bench.twin.fit import Twin, fit
from bench.twin.samples import stretches
from sim.config.params import ConfigError, load_params
from tests.choice import sampled

PAPER = 0
"""The seed whose turn is the paper's motor."""
MUST = ("motor.R_s", "motor.L_q", "motor.psi_f", "inverter.dead_time", "mechanics.J", "mechanics.b",
        "mechanics.tau_coulomb", "hall.offset_deg", "hall.latency", "encoder.offset_deg")  # fmt: skip
"""What every recording of steps tells."""
SEEDS = range(200, 222)
HARD = range(300, 322)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Steps and a reversal of a drive with the paper's motor, and its twin."""

    def make(folder: Path) -> None:
        drive = drawn(PAPER)
        twin = fit([run_of(steps(drive, folder / "steps.run"))])
        (folder / "twin.toml").write_text(twin.toml())
        reversal(drive, folder / "reversal.run", seed=77)

    return once(tmp_path_factory, "a_twin", make)


def beyond_limits(found: Checked) -> list[str]:
    """Currents that differ by more than 3 % rms, and statistics of position errors that do by more than 10 %."""
    currents = [f"{name}, rms" for name in ("i_a", "i_b", "i_c", "i_d", "i_q")]
    errors = [f"{name} error, {what}" for name in ("theta_avg", "theta_vt") for what in ("mean", "rms", "std")]
    limits = dict.fromkeys(currents, 0.03) | dict.fromkeys(errors, 0.10)
    return [name for name, limit in limits.items() if abs(found[name].relative) > limit]


def beyond(twin: Twin, truth: dict[str, float]) -> list[str]:
    """Quantities whose truth is not within their 95 % interval."""
    return [one.name for one in twin.quantities if one.name in truth and not one.covers(truth[one.name])]


@pytest.mark.long("makes two recordings and a twin")
def test_a_twin_does_what_the_drive_does_in_a_manoeuvre_that_was_not_fitted(made: Path) -> None:
    """Position-error statistics within 10 %, currents within 3 % rms, of a drive that differs in sixteen figures."""
    found = check(run_of(made / "reversal.run"), made / "twin.toml", seed=5, repeats=1)
    assert not found.tripped
    assert beyond_limits(found) == []
    assert found.edges[1] == pytest.approx(found.edges[0], rel=0.01)


def test_the_drive_as_it_takes_itself_is_seen_to_be_another(made: Path) -> None:
    """The same manoeuvre on what the firmware assumes: nothing was fitted."""
    run = run_of(made / "reversal.run")
    figures = tomllib.loads((made / "twin.toml").read_text())
    plain = made.parent / "plain.toml"
    plain.write_text(f"[encoder]\noffset_deg = {figures['encoder']['offset_deg']}\n")
    found = check(run, plain, repeats=1)
    assert len(beyond_limits(found)) > 3
    assert {"e_alpha, rms", "e_beta, rms"} <= {row.name for row in found.differing}


def test_a_twin_is_a_configuration_with_its_intervals(made: Path) -> None:
    params = load_params(made / "twin.toml")
    drive = drawn(PAPER)
    assert params.motor.R_s == pytest.approx(drive.truth["motor.R_s"], rel=0.01)
    assert params.firmware.psi_f_hat == np.float32(drive.config["firmware"]["psi_f_hat"])
    assert "95 %: +- " in (made / "twin.toml").read_text()


@pytest.mark.long("records five seconds of a drive and fits them")
@pytest.mark.parametrize("seed", sampled("twins", SEEDS, 1, campaign="twin"))
def test_what_was_drawn_is_within_its_interval(tmp_path: Path, seed: int) -> None:
    drive = drawn(seed)
    twin = fit([run_of(steps(drive, tmp_path / "steps.run"))])
    told = {one.name for one in twin.quantities}
    assert told.issuperset(MUST)
    assert len(beyond(twin, drive.truth)) <= 3, beyond(twin, drive.truth)  # of 33: chance has more of them once in 12
    assert all(twin[name].sd < 0.03 * abs(drive.truth[name]) for name in ("motor.R_s", "motor.L_q", "motor.psi_f"))


@pytest.mark.long("records five seconds of a drive and fits them")
@pytest.mark.parametrize("seed", sampled("hard twins", HARD, 1, campaign="twin"))
def test_intervals_hold_where_a_bench_has_what_the_twin_has_not(tmp_path: Path, seed: int) -> None:
    """Saturation, a dead time by its edges, drops of the switches, a weak link, late currents, uneven poles."""
    drive = drawn(seed, hard=True)
    twin = fit([run_of(steps(drive, tmp_path / "steps.run"))])
    assert len(beyond(twin, drive.truth)) <= 4, beyond(twin, drive.truth)
    assert all(twin[name].sd < 0.02 * abs(drive.truth[name]) for name in ("motor.psi_f", "mechanics.J"))


def test_a_recording_at_standstill_tells_no_inertia_and_says_so(tmp_path: Path) -> None:
    drive = drawn(PAPER)
    with bench.connect("sim", config=drive.config, save=tmp_path / "rest.run") as rig:
        rig.wait(0.2)
        rig.drive.start("encoder")
        for i_d in (1.0, 3.0, -2.0, 4.0):
            rig.drive.current(0.0, i_d)
            rig.wait(0.2)
    twin = fit([run_of(tmp_path / "rest.run")])
    told = {one.name for one in twin.quantities}
    assert "motor.R_s" in told
    assert twin["motor.R_s"].covers(drive.truth["motor.R_s"])
    assert not told & {"motor.psi_f", "mechanics.J", "mechanics.b", "hall.latency"}
    said = " ".join(twin.untold)
    assert "J, b, tau_coulomb, cogging: the shaft hardly turned" in said
    assert "psi_f: nothing in the recordings tells it" in said
    assert twin.values["motor.psi_f"] == np.float32(drive.config["firmware"]["psi_f_hat"])


def test_a_motor_that_is_faster_than_the_pwm_gets_shorter_integration_steps(tmp_path: Path) -> None:
    config = {"motor": {"R_s": 1.2, "L_d": 6e-5, "L_q": 6e-5}, "clock": {"substeps": 3}}
    with bench.connect("sim", config=config, save=tmp_path / "rest.run") as rig:
        rig.wait(0.2)
        rig.drive.start("encoder")
        for i_d in (0.5, 1.5, -1.0, 2.0):
            rig.drive.current(0.0, i_d)
            rig.wait(0.2)
    twin = fit([run_of(tmp_path / "rest.run")])
    (tmp_path / "twin.toml").write_text(twin.toml())
    params = load_params(tmp_path / "twin.toml")
    assert params.motor.R_s == pytest.approx(1.2, rel=0.02)
    assert params.clock.substeps >= 2


def test_what_a_drive_has_learned_of_its_dead_time_is_not_taken_for_the_dead_time(tmp_path: Path) -> None:
    drive = drawn(PAPER, **{"firmware.dead_time.dead_time_learn": 1})
    twin = fit([run_of(steps(drive, tmp_path / "learned.run"))])
    assert "inverter.dead_time" not in {one.name for one in twin.quantities}
    assert twin.values["inverter.dead_time"] == pytest.approx(drive.config["firmware"]["dead_time"]["dead_time_hat"])
    assert any(words.startswith("dead_time: the drive has learned") for words in twin.untold)
    assert twin["motor.psi_f"].covers(drive.truth["motor.psi_f"])


def test_edges_are_told_where_voltages_were_not_recorded(tmp_path: Path) -> None:
    drive = drawn(PAPER, **{"firmware.encoder_zero": 0.4})
    run = run_of(steps(drive, tmp_path / "few.run", channels="hall,theta_enc,i_a,i_b"))
    twin = fit([run])
    assert {one.name.partition(".")[0] for one in twin.quantities} == {"hall"}
    assert "winding, inverter, shaft: no voltages (u_alpha, u_beta, u_dc) recorded" in twin.untold
    assert "where the encoder's zero lies: hall.offset_deg is by the encoder as it is" in twin.untold
    offset = drive.truth["hall.offset_deg"] + drive.truth["encoder.offset_deg"]  # nothing tells the encoder's own
    assert twin["hall.offset_deg"].value == pytest.approx(offset, abs=0.1)


def test_the_angle_that_is_fitted_is_the_encoders_whatever_zero_the_drive_adds_meanwhile(tmp_path: Path) -> None:
    with bench.connect("sim", channels="hall,theta_enc,+theta_true", save=tmp_path / "zero.run") as rig:
        rig.load.speed(rpm=60)
        for zero in (0.0, 0.5, -2.0):
            rig.drive.set("encoder_zero", zero)
            rig.wait(0.2)
    run = run_of(tmp_path / "zero.run")
    pieces = list(stretches(run))
    true = np.concatenate([capture["theta_true"] for capture in captures(run)])
    assert len(pieces) >= 3
    theta = np.concatenate([piece.theta for piece in pieces if piece.theta is not None])
    assert len(theta) == len(true)
    assert np.abs(wrap(theta - true)).max() < 0.01


def test_nothing_to_fit_is_an_error_that_says_why(tmp_path: Path) -> None:
    with bench.connect("sim", save=tmp_path / "idle.run", channels="i_a,i_b") as rig:
        rig.wait(0.3)
    with pytest.raises(BenchError, match=r"idle\.run: nothing can be fitted: .*no voltages"):
        fit([run_of(tmp_path / "idle.run")])


def test_a_configuration_that_is_none_is_named(tmp_path: Path) -> None:
    (tmp_path / "other.toml").write_text("[motor]\nR_s = -1\n")
    with bench.connect("sim") as rig:
        idle = rig.record(0.1)
    with pytest.raises(ConfigError, match=r"motor\.R_s in .*other\.toml"):
        fit([run_of(idle)], tmp_path / "other.toml")


# -- directions -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(20))
def test_what_two_unknowns_do_alike_is_told_of_both_together_only(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, k = 400, int(rng.integers(3, 7))
    A = rng.normal(size=(n, k))
    one, other = rng.choice(k, 2, replace=False)
    share = rng.uniform(0.5, 2.0)
    A[:, other] = share * A[:, one]
    truth, start = rng.normal(size=k), rng.normal(size=k)
    y = A @ truth + 0.01 * rng.normal(size=n)
    told = solved(Equations(A, y, np.ones(k), [f"x{j}" for j in range(k)]), start)
    assert [set(names) for names in told.untold] == [{f"x{one}", f"x{other}"}]
    rest = [j for j in range(k) if j not in (one, other)]
    np.testing.assert_allclose(told.x[rest], truth[rest], atol=0.01)
    together = told.x[one] + share * told.x[other]
    assert together == pytest.approx(truth[one] + share * truth[other], abs=0.01)
    apart = share * told.x[one] - told.x[other]  # across it nothing has moved
    assert apart == pytest.approx(share * start[one] - start[other], abs=1e-9)


@pytest.mark.parametrize("seed", range(10))
def test_an_unknown_without_a_column_keeps_its_start_and_the_others_are_as_by_lstsq(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(100, 4))
    A[:, 2] = 0.0
    y = rng.normal(size=100)
    told = solved(Equations(A, y, np.full(4, 10.0), "abcd"), np.full(4, 7.0))
    assert told.untold == (("c",),)
    assert told.known == (True, True, False, True)
    assert told.x[2] == pytest.approx(7.0)
    np.testing.assert_allclose(told.x[[0, 1, 3]], np.linalg.lstsq(A[:, [0, 1, 3]], y)[0])


@pytest.mark.parametrize("seed", range(10))
def test_noise_in_what_is_known_makes_nothing_smaller_and_is_no_information(seed: int) -> None:
    """The last column is nothing but noise; ordinary least squares would make the first one half as large."""
    rng = np.random.default_rng(seed)
    n, sd = 20_000, np.array([1.0, 0.0, 1.0])
    clean = rng.normal(size=(n, 3)) * np.array([1.0, 1.0, 0.0])
    truth = np.array([2.0, -1.0, 3.0])
    y = clean @ truth + 0.1 * rng.normal(size=n)
    A = clean + sd * rng.normal(size=(n, 3))
    start = rng.normal(size=3)
    told = solved(Equations(A, y, np.ones(3), "abc", noise=np.diag(sd**2)), start)
    assert told.untold == (("c",),)
    np.testing.assert_allclose(told.x[:2], truth[:2], atol=5 * 2.0 / np.sqrt(n))
    assert told.x[2] == pytest.approx(start[2], abs=0.1)
    assert np.linalg.lstsq(A, y)[0][0] == pytest.approx(1.0, abs=0.1)


@pytest.mark.long("records five seconds of a drive, fits and follows them")
def test_an_encoder_may_stand_at_any_angle_and_run_backwards(tmp_path: Path) -> None:
    """The control goes by the Hall sensors, whose wires are exchanged and inverted as the firmware knows."""
    wires = {"firmware.hall_swap_hat": 4, "firmware.hall_invert_hat": 2, "firmware.encoder_reverse": 1,
             "firmware.encoder_zero": -0.7}  # fmt: skip
    drive = drawn(PAPER, **wires, **{
        "encoder.offset_deg": 155.0, "wiring.hall_swap": 4, "wiring.hall_invert": 2, "faults.encoder.reversed": 1,
    })  # fmt: skip
    twin = fit([run_of(steps(drive, tmp_path / "steps.run"))])
    assert twin["encoder.offset_deg"].value == pytest.approx(155.0, abs=0.1)
    assert len(beyond(twin, drive.truth)) <= 3, beyond(twin, drive.truth)
    (tmp_path / "twin.toml").write_text(twin.toml())
    found = check(run_of(tmp_path / "steps.run"), tmp_path / "twin.toml", repeats=1)
    assert abs(found["i_a, rms"].relative) < 0.05
    assert not found.tripped
