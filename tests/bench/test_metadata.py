"""Which drive was that, on which bench, by whom, with what: recordings and reports say it."""

from __future__ import annotations

import json
from importlib.metadata import version
from pathlib import Path

import pytest
from virtual_run import WatchedLink, run, simulated

from bench.cli import main
from bench.record.reader import Run
from bench.rig.settings import Settings

OWN_TEST = """
from bench.accept import limit
@limit("x", hi=1.0)
def test_it(drive, measure): measure("x", 0.0)
"""


def test_a_recording_says_what_it_is_of(tmp_path: Path) -> None:
    config = tmp_path / "motor.toml"
    config.write_text("[motor]\nR_s = 0.2\n[firmware.speed_loop]\nk_p_speed = 0.05\n")
    settings = Settings(station="bench 3", operator="A. Person", config=config)
    link = WatchedLink(simulated())
    run(link, save=tmp_path / "a.run", settings=settings)
    about = Run(tmp_path / "a.run").info.identity
    told = link.device.drive.identity
    assert (about["name"], about["serial"], about["build"]) == (told.name, told.serial, told.build)
    assert (about["station"], about["operator"]) == ("bench 3", "A. Person")
    assert about["configuration"] == {"file": str(config), "motor.R_s": 0.2, "firmware.speed_loop.k_p_speed": 0.05}
    assert about["hallbench"] == about["versions"]["hallbench"] == version("hallbench")
    assert about["versions"]["numpy"] == version("numpy")


def test_what_is_not_told_is_not_there(tmp_path: Path) -> None:
    run(WatchedLink(simulated()), save=tmp_path / "a.run")
    assert {"station", "operator", "configuration"}.isdisjoint(Run(tmp_path / "a.run").info.identity)


def test_an_acceptance_run_says_it_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The operator of the command line goes before that of bench.toml."""
    monkeypatch.chdir(tmp_path)
    Path("bench.toml").write_text('station = "bench <3>"\noperator = "nobody"\nconfig = "motor.toml"\n')
    Path("motor.toml").write_text("[motor]\nR_s = 0.2\n")
    Path("test_stated.py").write_text(OWN_TEST)
    options = ("--tests", "test_stated.py", "--report", "out", "--json", "a.json", "--operator", "A. Person")
    with pytest.raises(SystemExit) as end:
        main(["accept", "sim", *options])
    assert end.value.code == 0
    result = json.loads(Path("a.json").read_text())
    assert (result["station"], result["operator"]) == ("bench <3>", "A. Person")
    assert result["rig"]["configuration"] == "motor.toml: motor.R_s = 0.2"
    page = Path("out/report.html").read_text()
    assert "bench &lt;3&gt;" in page
    assert "A. Person" in page
    recorded = Run("out/recordings/it.run").info.identity
    assert (recorded["station"], recorded["operator"], recorded["test"]) == ("bench <3>", "A. Person", "it")
