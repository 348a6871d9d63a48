"""The command line: help with examples, JSON for scripts, plain lines when piped, completion."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import click
import pytest
from against import said as bench
from processes import ENVIRONMENT, LIMIT
from virtual_run import WatchedLink, reached_by, simulated

from bench.cli import cli
from bench.cli.live import Observer
from bench.record.reader import Run
from protocol import __version__
from protocol.signals import DRIVE_CHANNELS, DRIVE_PARAMETERS, LOAD_CHANNELS, SOURCE_NAMES

COMMANDS = ["live", "capture", "view", "mark", "plot", "measure", "compare", "import", "export", "accept", "conform"]
COMMANDS += [
    "commission",
    "response",
    "hall",
    "replay",
    "twin",
    "study",
    "tune",
    "score",
    "motor",
    "sim",
    "init",
    "devices",
    "info",
    "param",
]
COMMANDS += ["protocol", "completion"]


def test_the_commands_are_these() -> None:
    assert cli.list_commands(click.Context(cli)) == COMMANDS


@pytest.mark.parametrize("command", [(), *((name,) for name in COMMANDS)])
def test_help_has_an_example_that_parses(capsys: pytest.CaptureFixture[str], command: tuple[str, ...]) -> None:
    out, _ = bench(capsys, *command, "--help")
    assert out.startswith("Usage: bench")
    examples = [line.split() for line in out.splitlines() if line.startswith("  ") and " bench " in f"{line} "]
    assert any(words[:1] == ["bench"] for words in examples)
    assert bench(capsys, *command, "-h")[0] == out


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert bench(capsys, "--version")[0] == f"bench, version {__version__}\n"


def test_the_observer_of_a_run_may_be_written_either_way() -> None:
    kind = Observer(list(SOURCE_NAMES))
    assert [kind.convert(name, None, None) for name in ("edge_kalman", "edge-kalman")] == ["edge-kalman"] * 2
    with pytest.raises(click.BadParameter, match="is not one of 'encoder'"):
        kind.convert("learned", None, None)


def test_devices_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    ports = json.loads(bench(capsys, "devices", "--json")[0])
    assert isinstance(ports, list)
    for port in ports:
        assert port["target"].startswith("serial:")
        assert set(port) == {"target", "description", "manufacturer", "serial_number", "usb_id"}


def test_info_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    link = WatchedLink(simulated())
    with reached_by(link):
        out, err = bench(capsys, "info", "serial:x", "--json")
    info = json.loads(out)
    drive, load = info["nodes"]
    assert (info["target"], drive["identity"]["role"], load["identity"]["role"]) == ("serial:x", "drive", "load")
    assert drive["identity"]["boot_id"] == f"{link.device.drive.identity.boot_id:08x}"
    assert drive["identity"]["pwm_hz"] == 16000
    assert [node["identity"]["serial"] for node in (drive, load)] == ["SIM-0001", "SIM-0002"]
    assert drive["identity"]["build"].startswith(f"{__version__}-")
    assert "simulated" in drive["identity"]["features"]
    assert [c["name"] for c in drive["channels"]] == [c.name for c in DRIVE_CHANNELS]
    assert [c["name"] for c in load["channels"]] == [c.name for c in LOAD_CHANNELS]
    parameters = {p["name"]: p for p in drive["parameters"]}
    assert list(parameters) == [p.name for p in DRIVE_PARAMETERS]
    assert parameters["i_max"]["lo"] <= parameters["i_max"]["value"] == 8.0 <= parameters["i_max"]["hi"]
    assert drive["health"]["state"] == "IDLE"
    assert drive["health"]["outputs_on"] is False
    assert (drive["health"]["faults"], err) == ([], "")


def test_info_for_people_is_plain_when_piped(capsys: pytest.CaptureFixture[str]) -> None:
    with reached_by(WatchedLink(simulated())):
        out, _ = bench(capsys, "info", "serial:x")
    assert "\x1b" not in out
    assert "node 1: simulated drive (drive) on serial:x" in out
    for name in ("theta_vt", "psi_f_hat", "rad/s"):
        assert name in out
    assert [line.split()[-1] for line in out.splitlines() if line.startswith("  serial ")] == ["SIM-0001", "SIM-0002"]


def test_devices_tells_drives_apart_by_serial_and_build(capsys: pytest.CaptureFixture[str]) -> None:
    device = simulated()
    device.drive.identity = replace(device.drive.identity, serial="33FFD8054D48383611571943", build="9f2c61e µ")
    device.load.identity = replace(device.load.identity, serial="", build="")
    with patch("protocol.links.open_link", lambda target: WatchedLink(device)):
        rows = json.loads(bench(capsys, "devices", "serial:x", "--json")[0])
        out, _ = bench(capsys, "devices", "serial:x")
    assert [(row["serial"], row["build"]) for row in rows] == [("33FFD8054D48383611571943", "9f2c61e µ"), ("", "")]
    drive, load = out.splitlines()[1:]
    assert "  33FFD8054D48383611571943  9f2c61e µ  IDLE" in drive
    assert load.count("not told") == 2


def test_a_run_in_parts(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with reached_by(WatchedLink(simulated())):
        out, _ = bench(
            capsys, "live", "serial:x", "--duration", "12", "--save", str(tmp_path / "a.run"), "--split", "10s",
            "--viewer", "none", "--channels", "hall,theta_enc,i_q", "--json", "-",
        )  # fmt: skip
    summary = json.loads(out)
    assert summary["recording"]["parts"] == 2
    first, second = (Run(tmp_path / f"a-00{k}.run") for k in (1, 2))
    assert 0 <= len(first.samples) - 160_000 < 8_000  # whole chunks
    assert second.samples.index[0] == first.samples.index[-1] + 1
    assert len(first.samples) + len(second.samples) == summary["samples"]
    assert "# Summary" in second.summary


def test_live_as_json_is_all_that_goes_to_standard_output(capsys: pytest.CaptureFixture[str]) -> None:
    with reached_by(WatchedLink(simulated())):
        out, err = bench(
            capsys, "live", "serial:x", "--speed", "500", "--load", "1", "--duration", "2", "--viewer", "none",
            "--json", "-", "--host-observers",
        )  # fmt: skip
    summary = json.loads(out)
    assert (summary["result"], summary["duration_s"]) == ("ok", pytest.approx(2.0, abs=0.3))
    assert (summary["identity"]["name"], set(summary["lost"].values())) == ("simulated drive", {0})
    errors = summary["position_error_deg"]["500 r/min, 1 A"]
    assert (set(errors), set(errors["theta_vt"])) == ({"theta_avg", "theta_vt"}, {"n", "mean", "std", "max"})
    assert 0 <= errors["theta_vt"]["std"] < 60
    assert "\x1b" not in out + err


def test_live_for_people_is_plain_when_piped(capsys: pytest.CaptureFixture[str]) -> None:
    with reached_by(WatchedLink(simulated())):
        out, err = bench(capsys, "live", "serial:x", "--duration", "0.5", "--viewer", "none")
    assert "\x1b" not in out + err
    for text in ("0 samples, 0 edges", "0 frames", "result"):
        assert text in out
    assert "simulated drive hallbench-sim on serial:x" in err


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_scripts(capsys: pytest.CaptureFixture[str], shell: str) -> None:
    out, _ = bench(capsys, "completion", shell)
    assert "_BENCH_COMPLETE" in out


@pytest.mark.parametrize(("line", "completed"), [
    ("bench ", COMMANDS),
    ("bench live --h", ["--help", "--host-observers"]),
    ("bench live --viewer n", ["native", "none"]),
    ("bench info s", ["sim"]),
])  # fmt: skip
def test_completion_knows_commands_options_and_targets(capsys, monkeypatch, line: str, completed: list[str]) -> None:
    count = len(line.split()) - (not line.endswith(" "))
    for name, value in {"_BENCH_COMPLETE": "bash_complete", "COMP_WORDS": line, "COMP_CWORD": str(count)}.items():
        monkeypatch.setenv(name, value)
    assert {entry.partition(",")[2] for entry in bench(capsys)[0].split()} >= set(completed)


def test_help_imports_neither_numba_nor_rerun() -> None:
    code = (
        "import sys\nfrom bench.cli import main\n"
        "try: main(['--help'])\nexcept SystemExit: pass\n"
        "print(sorted({'numba', 'rerun', 'numpy', 'pyarrow'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=LIMIT, env=ENVIRONMENT)
    assert done.stdout.splitlines()[-1] == "[]"


def test_the_embedded_drive_is_started_before_numpy_is_imported() -> None:
    """Both take long, and there are two cores: to read the command line needs none of it."""
    code = (
        "import sys\nfrom unittest.mock import patch\nfrom bench.cli import cli\nimport bench.device.simulator\n"
        "class Started(Exception): pass\n"
        "with patch('bench.device.simulator.EmbeddedDrive', side_effect=Started):\n"
        "    try: cli(['live', 'sim', '--save', 'a.run', '--json', 'a.json'], standalone_mode=False)\n"
        "    except Started: print(sorted({'numpy', 'pyarrow', 'json', 'bench.rig.settings'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=LIMIT, env=ENVIRONMENT)
    assert done.stdout == "[]\n", done.stderr


def test_live_imports_numba_only_for_observers_on_the_host_and_no_configuration_of_a_simulated_drive() -> None:
    code = "import sys, bench.live.run; print({'numba', 'pydantic', 'scipy', 'sim.config'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=LIMIT, env=ENVIRONMENT)
    assert done.stdout == "set()\n"
