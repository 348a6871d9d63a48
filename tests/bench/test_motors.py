"""The motors that are shipped: each is described by its file alone, and the show and a check of its sensors work."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import pytest
from click.testing import CliRunner
from virtual_run import RecordingScreen, WatchedLink, run

from bench.cli import cli
from bench.device.simulator import motors
from bench.findings.health import Health, examine
from bench.hall.source import Options, opened
from bench.hall.trace import trace
from bench.live.run import LiveOutcome
from bench.rig.settings import read_settings
from bench.signal.verdict import Verdict
from sim.config.params import load_params
from sim.ports.device import SimulatedDevice
from tests.choice import chosen, sampled

pytestmark = [pytest.mark.long("a whole show for each fault")]

NO_LOAD = {  # r/min at 24 V by the figures that the sources have
    "anaheim-bly172s-24v": 60 * 24 / math.sqrt(3) / 0.0343291 / 4,  # V/Hz
    "gimbal-4310": 24 * 33,
    "hurst-dmb0224c10002": 24 / 7.56e-3,  # V peak between terminals by 1000 r/min
    "linix-45zwn24-40": 4000 * 24 / math.sqrt(3) / 12.9,
    "maxon-ec45-flat": 6710,
    "maxon-ec60-flat": 60 / math.tau * 24 / (0.289 / 5.47),  # rated torque over rated current
    "mcmaster-8080-70kv": 24 * 70,
    "nanotec-db59l024035": 4500,
    "robodrive-ilm50x08": 9000 / 2,  # on 48 V
    "teknic-m-2310p": 60 * 24 / math.sqrt(3) / 0.0399353 / 4,
}
each_motor = pytest.mark.parametrize("name", NO_LOAD)
turning_motor = pytest.mark.parametrize("name", sampled("motor", tuple(NO_LOAD), 1, campaign="motors"))


@contextmanager
def embedded(*arguments: object) -> Iterator[SimpleNamespace]:
    yield SimpleNamespace(target="tcp:127.0.0.1:1")


def show(name: str, **changed: float) -> LiveOutcome:
    """The show on this motor, with other values for some keys; the drive is in this process, in virtual time."""
    overrides = {key.replace("__", "."): value for key, value in changed.items()}
    link = WatchedLink(SimulatedDevice(load_params(motors()[name], overrides), 1))
    with patch("bench.live.run.EmbeddedDrive", embedded):
        return run(link, target=None, speed_rpm=None, duration=None)


def check(config: Path) -> Health:
    with opened(Options("sim", config=config), RecordingScreen(), None) as source:
        return examine(trace(source.turned.capture))


@each_motor
def test_a_file_names_its_source_and_nothing_in_it_contradicts(name: str) -> None:
    notes: list[str] = []
    load_params(motors()[name], None, notes.append)
    assert notes == []
    assert "# Source" in motors()[name].read_text()


@each_motor
def test_the_flux_linkage_is_that_of_the_sheets_speed(name: str) -> None:
    motor = load_params(motors()[name]).motor
    rpm = 24 / math.sqrt(3) / (motor.n_p * motor.psi_f) * 60 / math.tau
    assert rpm == pytest.approx(NO_LOAD[name], rel=0.06)


@turning_motor
def test_the_show_is_ok_and_its_estimates_are_as_good_as_on_the_papers_motor(name: str) -> None:
    ended = show(name)
    assert (ended.summary.result, ended.exit_code) == ("ok", 0)
    for title, rows in ended.summary.position_error_deg.items():
        if "average speed" in title:
            assert rows["theta_avg"]["std"] < 10.0
        else:
            assert rows["theta_vt"]["std"] < 4.0
            assert abs(rows["theta_vt"]["mean"]) < 2.0


@turning_motor
def test_a_check_finds_its_hall_sensors_healthy_and_where_they_are(name: str) -> None:
    health = check(motors()[name])
    assert health.verdict is Verdict.PASS
    for edge, delta in zip(health.measured.edges, load_params().hall.delta_deg, strict=True):
        assert math.degrees(edge.delta(edge.up)) == pytest.approx(delta - 0.25, abs=0.1)


@turning_motor
def test_wrong_pole_pairs_and_a_wrong_flux_linkage_are_named(name: str) -> None:
    motor = load_params(motors()[name]).motor
    for n_p in chosen("pole pairs", (motor.n_p - 1, motor.n_p + 1), 1):
        ended = show(name, firmware__n_p=n_p)
        assert f"wrong number of pole pairs: {n_p} in the drive, {motor.n_p} would fit" in ended.summary.result
        assert ended.exit_code == 1
    for factor in chosen("flux linkage", (0.5, 2.0), 1):
        ended = show(name, firmware__psi_f_hat=factor * motor.psi_f)
        said = re.search(
            r"psi_f_hat = (\S+) mV s, but by voltages, currents and angle it is (\S+) mV s", ended.summary.result
        )
        if said is None:  # the gimbal motor does not turn with twice its own, and that is what is said
            assert (name, factor, ended.exit_code) == ("gimbal-4310", 2.0, 1)
            assert "it turned at 0 r/min" in ended.summary.result
            continue
        assert float(said[1]) == pytest.approx(1e3 * factor * motor.psi_f, rel=0.01)
        assert (float(said[2]), ended.exit_code) == (pytest.approx(1e3 * motor.psi_f, rel=0.03), 1)


@turning_motor
def test_exchanged_and_broken_wires_are_never_ok(name: str) -> None:
    for fault in chosen("wires", ({"hall_swap": 1}, {"hall_swap": 4}, {"hall_open": 2}, {"hall_invert": 1}), 2):
        assert show(name, **{f"wiring__{key}": value for key, value in fault.items()}).exit_code == 1
    rotated = show(name, wiring__hall_swap=5)  # the one with which a motor turns: backwards, away
    assert "sensors rotated (a on c, b on a, c on b)" in rotated.summary.result


@turning_motor
@pytest.mark.parametrize(("fault", "cause"), [
    ("[wiring]\nhall_swap = 2\n", "sensors b and c exchanged"),
    ("[firmware]\nn_p = {}\n", "wrong number of pole pairs: {} in the drive, {} would fit"),
], ids=["exchanged", "pole pairs"])  # fmt: skip
def test_a_check_names_what_is_wrong(name: str, fault: str, cause: str, tmp_path: Path) -> None:
    n_p = load_params(motors()[name]).motor.n_p
    file = tmp_path / "faulty.toml"
    file.write_text(motors()[name].read_text() + fault.format(n_p + 1))
    health = check(file)
    [finding] = health.findings
    assert finding.cause.partition(";")[0] == cause.format(n_p + 1, n_p)


def test_the_page_has_their_figures() -> None:
    page = (Path(__file__).parents[2] / "docs" / "simulated-drive.md").read_text()
    for name, file in motors().items():
        params = load_params(file)
        m, rpm = params.motor, params.firmware.omega_m_max * 60 / math.tau
        L = " / ".join(f"{1e3 * x:.3g}" for x in sorted({m.L_d, m.L_q}, key=lambda x: x != m.L_d))
        torque = 1.5 * m.n_p * m.psi_f * m.i_max
        cells = f"{m.n_p} | {m.R_s:.3g} | {L} | {1e3 * m.psi_f:.3g} | {m.i_max:g} | {torque:.2g} | {rpm:.0f}"
        assert f"| [{name}](../sim/motors/{name}.toml) | {cells} |" in page


def test_a_bench_toml_may_name_one(tmp_path: Path) -> None:
    (tmp_path / "bench.toml").write_text('config = "maxon-ec60-flat"\n')
    assert read_settings(tmp_path / "bench.toml").config == motors()["maxon-ec60-flat"]
    (tmp_path / "maxon-ec60-flat").write_text("[motor]\nR_s = 1.0\n")  # a file of that name comes first
    assert read_settings(tmp_path / "bench.toml").config == tmp_path / "maxon-ec60-flat"


def test_they_are_listed_and_a_wrong_name_is_told_the_next() -> None:
    listed = CliRunner().invoke(cli, ["sim", "--motors"])
    assert listed.exit_code == 0
    assert [line.split()[0] for line in listed.output.splitlines()[1:]] == [*sorted(NO_LOAD), "bench24v"]
    refused = CliRunner().invoke(cli, ["sim", "--config", "maxon-ec45"])
    assert refused.exit_code == 2
    assert "no file and no motor named 'maxon-ec45'; did you mean maxon-ec45-flat?" in refused.output
