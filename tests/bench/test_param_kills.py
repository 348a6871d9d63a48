"""A drive that loses its power while parameters are written to it: old or new, never half, and the host says which.

Real processes: the simulated drive with its store is ended by SIGKILL at a random moment of `bench param load --save`,
and started again on the same port.
"""

from __future__ import annotations

import json
import random
import signal
import subprocess
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from processes import Program, Sim

from bench.param import sources
from bench.param.table import Parameters

pytestmark = [pytest.mark.alone, pytest.mark.long("real time, a process for each drive and host")]

LOADED = 0.12  # s that a load takes, about, after it has said what differs
NEW = {
    "k_p_vt": 901.5, "k_i_vt": 40000.0, "i_max": 6.25, "edge_up_1": 0.0125, "edge_up_6": -0.0125, "edge_down_3": 0.02,
    "bw_current": 650.0, "u_dc_max": 40.0, "tau_max": 0.0004, "k_p_speed": 0.15, "hall_offset": 0.25, "J_hat": 0.0003,
}  # fmt: skip


def values(target: str) -> Parameters:
    return sources.read(target)


def stored(store: Path) -> dict[str, float]:
    return json.loads(store.read_text()) if store.exists() else {}


def killed(
    moment: float, start: Callable[..., Program], start_sim: Callable[..., Sim], folder: Path
) -> tuple[bool, int, str]:
    """Whether the drive had the new values after it had lost its power; exit code and words of the host."""
    store, file, kept = folder / "store.json", folder / "new.toml", {"XDG_DATA_HOME": str(folder / "kept")}
    sim = start_sim("--tcp", "127.0.0.1:0", "--store", str(store))
    before = dict(values(sim.target))
    # a dump with other values, as an editor would leave it
    file.write_text(
        f'[dump]\nserial = "{values(sim.target).serial}"\n[parameters]\n'
        + "".join(f"{name} = {value!r}\n" for name, value in NEW.items())
    )
    load = start("param", "load", str(file), sim.target, "--yes", "--save", more=kept)
    load.line(rf"^{len(NEW)} differences in")
    with suppress(subprocess.TimeoutExpired):
        load.process.wait(moment)
    sim.send(signal.SIGKILL)
    sim.end()
    half = stored(store)
    assert not half or all(np.float32(half[name]) == np.float32(value) for name, value in NEW.items())
    again = start_sim("--tcp", sim.target.removeprefix("tcp:"), "--store", str(store))
    code = load.end()
    after = dict(values(again.target))
    again.send(signal.SIGKILL)
    again.end()
    new = {**before, **{name: float(np.float32(value)) for name, value in NEW.items()}}
    assert after in (before, new)
    assert (after == new) == bool(half)
    return after == new, code, "\n".join([*load.out, *load.err])


def check(has_new: bool, code: int, words: str) -> None:
    """The host's exit code and words are what the drive has."""
    if has_new:
        assert code == 0, words
        assert "the new parameters, all of them" in words or "read back; it stored them" in words
    else:
        assert code == 1, words
        assert "it has the old parameters; nothing of the new ones is stored" in words
    assert "Traceback" not in words


@pytest.mark.parametrize("number", range(5))
def test_a_drive_that_loses_its_power_in_a_load_has_old_or_new(number: int, start, start_sim, tmp_path: Path) -> None:
    moment = random.Random(number).uniform(0.0, LOADED)
    check(*killed(0.0 if number == 0 else moment, start, start_sim, tmp_path))


@pytest.mark.campaign("param-kills")
@pytest.mark.parametrize("number", range(50))
def test_fifty_times(number: int, start, start_sim, tmp_path: Path) -> None:
    check(*killed(LOADED * number / 50, start, start_sim, tmp_path))
