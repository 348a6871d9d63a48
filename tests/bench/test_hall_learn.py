"""`bench hall learn`: what is written, to whom, and when nothing is."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from hall_motor import REAL, TABLE_I, capture
from virtual_run import simulated

from bench.cli import main
from bench.device.client import Client
from bench.device.node import LOAD, Node
from bench.errors import BenchError, NodeError
from bench.hall.health import examine
from bench.hall.learn import Learnt, learnt, save, write
from bench.hall.trace import trace
from sim.config.params import load_params
from sim.ports.device import SimulatedDevice
from sim.ports.virtual import VirtualLink

TARGET = f"serial:/dev/ttyLEARN-{os.getpid()}"  # its own: a rig holds its target
NAMES = [f"{name}_{s}" for name in ("edge_up", "edge_down") for s in range(1, 7)]


def learn(device: SimulatedDevice, *arguments: str) -> None:
    with patch("bench.rig.connection.open_link", lambda target: VirtualLink(device)):
        main(["hall", "learn", TARGET, *arguments])


def stored(device: SimulatedDevice) -> list[float]:
    return [device.bench.parameters[name] for name in NAMES]


def test_the_edges_that_the_drive_has_are_in_its_parameters_afterwards(capsys: pytest.CaptureFixture[str]) -> None:
    device = simulated()
    before = dict(device.bench.parameters)
    learn(device, "--yes", "--write")
    degrees = np.degrees(stored(device))
    assert degrees[:6] == pytest.approx(np.array(TABLE_I) - 0.25, abs=0.06)
    assert degrees[6:] == pytest.approx(np.array(TABLE_I) + 0.25, abs=0.06)
    changed = {name for name, value in device.bench.parameters.items() if value != before[name]}
    assert changed == set(NAMES)
    assert "12 parameters written to node 1 and read back" in capsys.readouterr().out.splitlines()


def test_without_write_nothing_is_written(capsys: pytest.CaptureFixture[str]) -> None:
    device = simulated()
    learn(device, "--yes")
    assert stored(device) == [0.0] * 12
    assert "HEALTHY" in capsys.readouterr().out


def test_a_fault_is_told_and_nothing_is_written(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    device = simulated(wiring__hall_swap=1)
    with pytest.raises(SystemExit) as ended:
        learn(device, "--yes", "--write", "--out", str(tmp_path / "edges.toml"))
    assert ended.value.code == 2
    err = capsys.readouterr().err
    assert (
        "error: no edges learnt: sensors a and b exchanged; connect the sensors to the inputs of their names; " in err
    )
    assert stored(device) == [0.0] * 12
    assert not (tmp_path / "edges.toml").exists()


def test_edges_known_too_badly_are_refused_with_how_badly() -> None:
    rough = REAL.but(jitter_deg=1.2)
    short = ((60.0, 0.9), (0.0, 0.05), (-60.0, 0.9))
    with pytest.raises(
        BenchError, match=r"one is known to \+-(\d\.\d\d) deg only \(95 %, [78] passages\), 0.5 deg are"
    ):
        learnt(examine(trace(capture(rough.but(turns=short)))))
    long = ((60.0, 9.0), (0.0, 0.05), (-60.0, 9.0))
    found = learnt(examine(trace(capture(rough.but(turns=long)))))
    assert np.degrees(found.edge_up) == pytest.approx(np.array(TABLE_I) - 0.25, abs=0.5)


def test_too_little_data_is_refused_with_what_to_do() -> None:
    with pytest.raises(BenchError, match=r"no edges learnt: the shaft turned 19\.1 electrical turns up and 0\.0 down"):
        learnt(examine(trace(capture(REAL.but(turns=((60.0, 2.0),))))))


# -- drives that will not have them -----------------------------------------------------------------------------


def nodes(device: SimulatedDevice) -> tuple[Node, Node]:
    client = Client(VirtualLink(device))
    return Node(client, client.connect().node), Node(client, LOAD)


SOME = Learnt((0.1, 0.2, 0.3, -0.1, -0.2, -0.3), (0.01, 0.02, 0.03, 0.04, 0.05, 0.06))


def test_a_refusal_half_way_puts_back_what_was_there() -> None:
    device = simulated()
    drive, _ = nodes(device)
    write(drive, SOME)
    assert stored(device) == pytest.approx([*SOME.edge_up, *SOME.edge_down])
    beyond = Learnt((0.2,) * 6, (0.2, 0.2, 0.6, 0.2, 0.2, 0.2))
    with pytest.raises(NodeError, match=r"edge_down_3 must be -0.506..0.506, got 0.6"):
        write(drive, beyond)
    assert stored(device) == pytest.approx([*SOME.edge_up, *SOME.edge_down])


def test_a_device_without_the_parameters_is_left_alone() -> None:
    _, load = nodes(simulated())
    with pytest.raises(BenchError, match=r"^node 2 has no parameter 'edge_up_1'"):
        write(load, SOME)


# -- files ------------------------------------------------------------------------------------------------------


def test_a_toml_file_is_a_configuration_of_the_simulated_drive(tmp_path: Path) -> None:
    save(tmp_path / "edges.toml", SOME)
    edges = load_params(tmp_path / "edges.toml").firmware.hall_edges
    assert edges.edge_up == pytest.approx(SOME.edge_up)
    assert edges.edge_down == pytest.approx(SOME.edge_down)


def test_a_json_file_has_the_same_numbers_with_their_unit(tmp_path: Path) -> None:
    save(tmp_path / "edges.json", SOME)
    data = json.loads((tmp_path / "edges.json").read_text())
    assert data == {"unit": "rad", "edge_up": list(SOME.edge_up), "edge_down": list(SOME.edge_down)}


def test_a_recording_is_learnt_into_a_file(tmp_path: Path) -> None:
    run, out = tmp_path / "run.rrd", tmp_path / "edges.json"
    main(["hall", "learn", "sim", "--save", str(run)])
    main(["hall", "learn", str(run), "--out", str(out)])
    up = json.loads(out.read_text())["edge_up"]
    assert [math.degrees(value) for value in up] == pytest.approx(np.array(TABLE_I) - 0.25, abs=0.06)
