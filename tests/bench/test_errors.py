"""What a user can get wrong, and what can be wrong with a link: one line, an exit code, nothing energised."""

from __future__ import annotations

import contextlib
import random
import re
import signal
import socket
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from processes import LIMIT, Program, Sim
from shared import table
from virtual_run import WatchedLink, never_armed, reached_by, simulated

from bench.cli import main
from protocol.links import Link
from protocol.messages import Role

pytestmark = pytest.mark.slow

Fail = Callable[..., str]
WRONG = table("errors")


@pytest.fixture
def fail(capsys: pytest.CaptureFixture[str]) -> Fail:
    """Run `bench ARGUMENTS…` in this process and return its one line of error; `link` stands for any target."""

    def run(*arguments: str, link: Link | None = None, code: int = 2) -> str:
        reached = contextlib.nullcontext() if link is None else reached_by(link)
        with reached, pytest.raises(SystemExit) as ended:
            main(list(arguments))
        assert ended.value.code == code
        return one_error(capsys.readouterr().err)

    return run


def one_error(err: str) -> str:
    errors = [line for line in err.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1, err
    assert err.splitlines()[-1] == errors[0]
    assert "Traceback" not in err
    return errors[0]


# -- targets ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("target", "says"), WRONG["target"])
@pytest.mark.parametrize("command", ["live", "info"])
def test_a_target_that_is_not_there(fail: Fail, command: str, target: str, says: str) -> None:
    assert re.search(says, fail(command, target))


@pytest.mark.real_time
@pytest.mark.long("waits 7 s for an answer")
def test_a_wrong_baud_rate(start_sim: Callable[..., Sim], fail: Fail) -> None:
    sim = start_sim("--pty", "--baud", "3000000")
    assert sim.target.endswith("?baud=3000000")
    error = fail("live", sim.target.partition("?")[0], "--speed", "500", "--viewer", "none")
    assert re.search(r"no HBP device answered .*\(\d+ bytes heard.*check .*baud rate", error)
    assert not any("outputs on" in line for line in sim.out)


@pytest.mark.parametrize(("said", "words"), [
    (b"", r"within 3 s \(0 bytes heard.*check power, cable, target and"),
    (random.Random(1).randbytes(20_000), r"\(20000 bytes heard, 0 good frames, [1-9]\d* damaged\)"),
], ids=["silent", "not HBP"])  # fmt: skip
@pytest.mark.parametrize("command", ["live", "info"])
def test_something_else_at_the_other_end(fail: Fail, command: str, said: bytes, words: str) -> None:
    class SomethingElse(WatchedLink):
        left = said

        def read(self, timeout: float, settle: float = 0.0) -> bytes:
            super().read(timeout, settle)
            now, self.left = self.left, b""
            return now

    error = fail(command, "serial:x", link=SomethingElse(simulated()))
    assert error.startswith("error: no HBP device answered on ")
    assert re.search(words, error)


def test_a_signal_while_connecting(start: Callable[..., Program]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(LIMIT)
        for number in (signal.SIGTERM, signal.SIGINT):
            live = start("live", f"tcp:127.0.0.1:{server.getsockname()[1]}", "--viewer", "none")
            client, _ = server.accept()
            with client:
                live.send(number)
                assert live.end() == 128 + number
            assert one_error("\n".join(live.err))


def test_a_device_that_is_no_drive(fail: Fail) -> None:
    device = simulated()
    device.drive.identity = replace(device.drive.identity, role=Role.LOAD)
    link = WatchedLink(device)
    assert "is a LOAD, not a drive" in fail("live", "serial:x", "--speed", "500", link=link)
    assert never_armed(link)


# -- options ----------------------------------------------------------------------------------------------------

SPIN = ("live", "serial:x", "--viewer", "none", "--duration", "0.2", "--speed", "100")


@pytest.mark.parametrize(("arguments", "says"), WRONG["live"])
def test_an_option_that_cannot_be(fail: Fail, tmp_path, monkeypatch, arguments: str, says: str) -> None:
    monkeypatch.chdir(tmp_path)
    Path("there.toml").touch()
    link = WatchedLink(simulated())
    assert re.search(says, fail(*SPIN, *arguments.split(), link=link))
    assert never_armed(link)
    assert [path.name for path in tmp_path.iterdir()] == ["there.toml"]


def test_the_web_viewers_port_in_use(fail: Fail) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        link = WatchedLink(simulated())
        error = fail(*SPIN, "--viewer", "web", "--web-port", str(port), link=link, code=4)
    assert f"port {port} for the web viewer is in use" in error
    assert never_armed(link)


def test_an_observer_for_a_drive_that_is_only_watched(fail: Fail) -> None:
    assert "--observer needs --speed, --load or --profile" in fail("live", "serial:x", "--observer", "encoder")


# -- the simulated drive's configuration ------------------------------------------------------------------------


@pytest.mark.parametrize("command", [("sim", "--pty"), ("live", "sim"), ("live",)])
def test_a_configuration_with_a_negative_resistance(fail: Fail, tmp_path: Path, command: tuple[str, ...]) -> None:
    config = tmp_path / "bad.toml"
    config.write_text("[motor]\nR_s = -1\n")
    assert fail(*command, "--config", str(config)) == "error: R_s must be > 0 ohm, got -1 (motor.R_s in bad.toml)"


@pytest.mark.parametrize(("arguments", "says"), WRONG["sim"])
def test_a_simulated_drive_that_cannot_be(fail: Fail, arguments: str, says: str) -> None:
    assert re.search(says, fail("sim", *arguments.split()))


def test_a_taken_tcp_port(fail: Fail) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        assert f"cannot listen on tcp:{address}: Address already in use" in fail("sim", "--tcp", address)
