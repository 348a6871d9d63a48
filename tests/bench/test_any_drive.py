"""A drive that is not the simulated one: every command does what it can with what the drive says of itself.

`own` has six channels and three parameters of its own names, no encoder, no edges, no currents; the others are the
usual drive less something. The device itself is held to protocol/SPEC.md by tests/protocol.
"""

from __future__ import annotations

import json
import re
from functools import partial
from itertools import product
from math import tau
from pathlib import Path

import pytest
from against import ACCEPT, HALL, INFO, LINKS, LOOK, SPIN, WATCH, bench

from bench.record.reader import Run
from tests.choice import sampled
from tests.devices import FULL, OWN, serving
from tests.devices.spec import Feature, State

pytestmark = pytest.mark.slow

ROWS = ("v_bus", "w_target", "w_meas", "pos_e", "temp_fet", "duty", "kp_w", "ki_w", "vbus_min")
UNTRUE = r"nan r/min|KeyError|did you mean"

LESS = {
    "encoder": FULL.without("theta_enc", "omega_enc"),
    "n_p": FULL.without("n_p"),
    "observer": FULL.without("observer"),
    "edges": FULL.without(features=Feature(0)),
    "hall": FULL.without("hall", features=Feature(0)),
    "currents": FULL.without("i_a", "i_b", "i_c", "i_d", "i_q"),
    "i_max": FULL.without("i_max"),
    "omega_m_max": FULL.without("omega_m_max"),
    "watchdog": FULL.without("watchdog"),
    "estimates": FULL.without("theta_vt", "omega_vt", "theta_avg", "omega_avg"),
    "status": FULL.without("status"),
    "parameters": FULL.without(*(str(row.name) for row in FULL.parameters)),
    "all but status": FULL.without(*(str(row.name) for row in FULL.channels[:1] + FULL.channels[2:])),
}
"""The usual drive without something."""


own = partial(serving, "own", (), watchdog=1.0)  # more than SPEC's 0.2 s: the machine may be busy
usual = partial(serving, watchdog=1.0)


# -- a drive as it should be ------------------------------------------------------------------------------------


@pytest.mark.parametrize("link", ["bytes", "CAN"])
def test_a_healthy_drive(link: str, capsys: pytest.CaptureFixture[str]) -> None:
    with usual("full", (), link) as device:
        ran = bench(SPIN + " --fit", device, capsys)
        assert ran.code == 0, ran.text
        assert re.search("result +ok", ran.text)
        assert re.search("lost by index +0 samples, 0 edges", ran.text)
        assert (device.motor.fastest, device.state) == (pytest.approx(300 * tau / 60, rel=0.05), State.IDLE)
        ran = bench(INFO, device, capsys)
        assert ran.code == 0
        assert "serial 33FFD8054D48383611571943 build 9f2c61e-dirty" in ran.text


@pytest.mark.real_time
@pytest.mark.parametrize("link", sampled("real link", ("pty", "tcp", "slcan", "virtual"), 1, campaign="links"))
def test_a_healthy_drive_on_a_real_link(link: str, capsys: pytest.CaptureFixture[str]) -> None:
    test_a_healthy_drive(link, capsys)


@pytest.mark.parametrize(("command", "says"), [(ACCEPT, "PASS"), (HALL, "HEALTHY: wired as specified")])
def test_a_healthy_drive_passes(command: str, says: str, capsys: pytest.CaptureFixture[str]) -> None:
    with usual("full", (), "bytes") as device:
        ran = bench(command, device, capsys)
    assert ran.code == 0, ran.text
    assert says in ran.text


# -- a drive of its own names -----------------------------------------------------------------------------------


@pytest.mark.parametrize("link", LINKS)
def test_a_drive_of_its_own_names_is_shown_streamed_and_spun(link: str, capsys: pytest.CaptureFixture[str]) -> None:
    with own(link) as device:
        ran = bench(INFO, device, capsys)
        assert ran.code == 0, ran.text
        assert all(re.search(rf"^{row} ", ran.out, re.M) for row in ROWS), ran.out
        assert re.search("serial +not told\n +build +not told\n", ran.out)
        ran = bench(WATCH + " --json -", device, capsys)
        assert ran.code == 0, ran.text
        assert not re.search(UNTRUE, ran.text)
        assert "6 channels" in ran.text
        assert json.loads(ran.out)["samples"] > 75
        assert device.seen["ARM"] == 0
        ran = bench(SPIN.replace("300", "100"), device, capsys)
        assert not device.outputs_on
        assert ran.code == 0, ran.text
        assert re.search("result +(ok|.*unverified)", ran.text), ran.text
        assert not re.search(UNTRUE, ran.text)
    assert device.motor.fastest == pytest.approx(100 * tau / 60, rel=0.05)


@pytest.mark.parametrize("command", [HALL, LOOK])
def test_hall_says_what_a_drive_of_its_own_names_lacks(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with own("bytes") as device:
        ran = bench(command, device, capsys)
    assert ran.code == 2, ran.text
    assert re.search("[Hh]all", ran.text)
    assert "EDGES" in ran.text or "edges" in ran.text
    assert device.seen["ARM"] == 0


def test_accept_skips_what_a_drive_of_its_own_names_cannot_show(capsys: pytest.CaptureFixture[str]) -> None:
    with own("bytes") as device:
        ran = bench("accept TARGET --yes --allow-skipped", device, capsys)  # which does not make nothing a PASS
    assert ran.code == 6, ran.text
    assert len(re.findall(r"^SKIPPED +\S+: *\S+", ran.err, re.M)) > 30
    assert not re.search(r"\b(ERROR|FAIL|INVALID)\b", ran.text), ran.text
    assert "INCOMPLETE" in ran.text
    assert "nothing was tested" in ran.text
    assert "passed" not in ran.text


def test_a_recording_of_a_drive_of_its_own_names(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "own.run"
    with own("bytes") as device:
        assert bench(f"{SPIN} --save {run}", device, capsys).code == 0
        for command in (f"score {run}", f"replay {run} -o {tmp_path / 'out.run'}", f"hall check {run}"):
            ran = bench(command, device, capsys)
            assert ran.code == 2, ran.text
            assert not re.search(UNTRUE, ran.text)
    recorded = Run(run)
    assert [channel.name for channel in recorded.info.channels] == [row.name for row in OWN.channels]
    assert (recorded.info.identity["serial"], recorded.info.identity["build"]) == ("", "")


# -- drives that lack something ---------------------------------------------------------------------------------


MISSING = {"n_p": "n_p", "edges": "[Ee]dges|EDGES", "hall": "hall", "all but status": "hall", "parameters": "n_p"}
"""What `bench hall` must name, which needs it."""
WITHOUT = [*product((SPIN,), LESS), *sampled("lacking", product((ACCEPT,), LESS), 5, campaign="links")]


@pytest.mark.parametrize(("command", "less"), [*WITHOUT, *product((HALL,), MISSING)])
def test_a_drive_without_something(command: str, less: str, capsys: pytest.CaptureFixture[str]) -> None:
    """It turns, the tests are skipped, or it is said what is missing; nothing that it lacks makes it fail."""
    with usual(LESS[less], (), "bytes") as device:
        ran = bench(command, device, capsys)
        assert not device.outputs_on
    assert not re.search(UNTRUE, ran.text), ran.text
    if command is SPIN:
        assert ran.code == 0, ran.text
        assert device.motor.fastest == pytest.approx(300 * tau / 60, rel=0.05)
    elif command is ACCEPT:
        assert ran.code in (0, 6), ran.text
        assert not re.search(r"\b(ERROR|FAIL|INVALID)\b", ran.text), ran.text
    else:
        assert ran.code == 2, ran.text
        assert re.search(MISSING[less], ran.text), ran.text
