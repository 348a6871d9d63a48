"""`bench hall learn`: what is written, to whom, and when nothing is."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from hall_motor import REAL, TABLE_I, Motor, capture
from virtual_run import WatchedLink, simulated

from bench.cli import main
from bench.device.client import Client
from bench.device.node import LOAD, Node
from bench.errors import BenchError, NodeError
from bench.findings.health import Health, examine
from bench.hall.learn import Learnt, learnt, save, write
from bench.hall.trace import trace
from bench.signal.verdict import Verdict
from protocol.messages import DriveState, Feature, SetpointMode
from sim.config.params import load_params
from sim.ports.device import SimulatedDevice
from sim.ports.virtual import VirtualLink
from tests.bench.hall_cases.drives import MOTORS, drawn, healthy, telling_ring, top_rpm
from tests.bench.hall_cases.recording import NONE, Encoder, Recording, Sensors
from tests.bench.hall_cases.shaft import check
from tests.choice import chosen, sampled

TARGET = f"serial:/dev/ttyLEARN-{os.getpid()}"  # its own: a rig holds its target
NAMES = [f"{name}_{s}" for name in ("edge_up", "edge_down") for s in range(1, 7)]


def learn(device: SimulatedDevice, *arguments: str) -> None:
    with patch("bench.rig.connection.open_link", lambda target: VirtualLink(device)):
        main(["hall", "learn", TARGET, *arguments])


def refused(capsys: pytest.CaptureFixture[str], device: SimulatedDevice | None, *arguments: str) -> str:
    """What `bench hall learn`, on a drive or as these arguments say, writes as it ends with 2."""
    with pytest.raises(SystemExit) as ended:
        learn(device, *arguments) if device else main(["hall", "learn", *arguments])
    assert ended.value.code == 2
    return capsys.readouterr().err


@pytest.fixture(scope="module")
def learnable(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording that `bench hall learn` has made of the simulated drive."""
    run = tmp_path_factory.mktemp("learnable") / "run.run"
    main(["hall", "learn", "sim", "--save", str(run)])
    return run


def by_formula(motor: Motor) -> Learnt:
    """What is learnt of a recording by formula."""
    recorded = capture(motor)
    return learnt(examine(trace(recorded)), recorded.parameters)


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
    assert changed == {*NAMES, "edge_sd"}
    assert math.degrees(device.bench.parameters["edge_sd"]) == pytest.approx(0.5, abs=0.02)
    assert "13 parameters written to node 1 and read back" in capsys.readouterr().out.splitlines()


def test_without_write_nothing_is_written(capsys: pytest.CaptureFixture[str]) -> None:
    device = simulated()
    learn(device, "--yes")
    assert stored(device) == [0.0] * 12
    assert "HEALTHY" in capsys.readouterr().out


def test_a_fault_is_told_and_nothing_is_written(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    device = simulated(wiring__hall_open=2)
    err = refused(capsys, device, "--yes", "--write", "--out", str(tmp_path / "edges.toml"))
    assert "error: no edges learned: sensor b open (always 1); measure the wire of sensor b, its supply and " in err
    assert stored(device) == [0.0] * 12
    assert not (tmp_path / "edges.toml").exists()


def test_edges_known_too_badly_are_refused_with_how_badly() -> None:
    rough = REAL.but(jitter_deg=1.2)
    short = ((60.0, 0.9), (0.0, 0.05), (-60.0, 0.9))
    with pytest.raises(
        BenchError, match=r"certain is known to \+-(\d\.\d\d) deg \(95 %, [78] passages\); \+-0.5 deg are"
    ):
        by_formula(rough.but(turns=short))
    long = ((60.0, 9.0), (0.0, 0.05), (-60.0, 9.0))
    found = by_formula(rough.but(turns=long))
    assert np.degrees(found.edge_up) == pytest.approx(np.array(TABLE_I) - 0.25, abs=0.5)


def test_too_little_data_is_refused_with_what_to_do() -> None:
    with pytest.raises(BenchError, match=r"only 19\.1 electrical revolutions forward and 0\.0 reverse"):
        by_formula(REAL.but(turns=((60.0, 2.0),)))


# -- what the same evidence contradicts -------------------------------------------------------------------------

TWICE = ((60.0, 2.0), (120.0, 1.5), (0.0, 0.05), (-60.0, 2.0), (-120.0, 1.5))  # no third leg


def slipped(deg: float, after: float) -> Motor:
    """The paper's motor, whose encoder slips once the shaft has come so far down from its highest place, el. turns."""

    def angle(theta: np.ndarray) -> np.ndarray:
        top = int(np.argmax(theta))
        gone = (np.arange(len(theta)) >= top) & (theta <= theta[top] - math.tau * after)
        return theta + np.radians(deg) * np.maximum.accumulate(gone)

    return REAL.but(encoder=angle, without=("u_alpha", "u_beta"))


@pytest.mark.parametrize(("deg", "after", "words"), [
    (1.0, 9.0, r"all edges moved by 1\.0 deg while the shaft turned, as an encoder that slips makes them"),
    (1.2, 0.0, r"all edges have a hysteresis of -0\.7 deg, which no sensor has"),
    (-5.0, 0.0, r"edges are known to 2\.\d deg \(standard deviation\): a hysteresis of 5\.5 deg in the mean may hide"),
])  # fmt: skip
def test_a_slip_that_is_less_than_a_fault_is_refused_all_the_same(deg: float, after: float, words: str) -> None:
    with pytest.raises(BenchError, match=words):
        by_formula(slipped(deg, after))


def test_what_a_reversal_may_hide_is_in_edge_sd() -> None:
    """Sensors have 2 deg of hysteresis at most: with 0.5, a slip of 1.5 deg where the shaft turned would not show."""
    twice = by_formula(REAL.but(turns=TWICE))
    again = by_formula(REAL.but(turns=(*TWICE, (0.0, 0.05), (90.0, 0.5))))
    assert math.degrees(again.edge_sd) == pytest.approx(0.5, abs=0.02)
    assert math.degrees(twice.edge_sd) == pytest.approx(math.hypot(0.5, 1.5 / 2.0), abs=0.03)
    alike = by_formula(REAL.but(turns=((90.0, 2.0), (0.0, 0.05), (-90.0, 2.0), (0.0, 0.05), (90.0, 1.0))))
    assert math.degrees(alike.edge_sd) == pytest.approx(math.hypot(0.5, 0.5 / 2.0), abs=0.02)  # a delay may be in it


@pytest.mark.parametrize("seed", [
    *sampled("what learning may be fooled by", range(400), 12, campaign="hall"),
])  # fmt: skip
def test_edges_are_refused_or_no_farther_off_than_three_times_edge_sd(seed: int) -> None:
    """A slip, late pull-ups, lost counts or jitter, of any size, in any motor: against the edges of the formula."""
    made = fooling(seed)
    recorded = made.capture()
    try:
        found = learnt(examine(trace(recorded)), recorded.parameters)
    except BenchError:
        return
    true = edges_of(made.sensors, made.parameters["hall_offset"])
    off = np.degrees([*found.edge_up, *found.edge_down]) - true
    slip = sum(size for _, size in (made.encoder or Encoder()).slips)  # the encoder was right before it, or after it
    worst = max(float(np.abs(off).max()), min(float(np.abs(off + by).max()) for by in (slip, -slip)))
    assert worst <= 3.0 * math.degrees(found.edge_sd)


@pytest.mark.slow
def test_what_is_fooling_is_not_all_refused_and_healthy_drives_are_learnt() -> None:
    kept = 0
    told = [seed for seed in range(0, 300, 5) if seed % 50 != 40]  # 40: one pole pair, by hand
    for seed in chosen("healthy drives that are learnt", told, 6):
        made = telling_ring(healthy(seed).but(encoder=Encoder()))
        recorded = made.capture()
        health = examine(trace(recorded))
        if health.verdict is Verdict.PASS:
            if made.resolution and math.degrees(health.resolution) > 0.5 and too_coarse(health, recorded.parameters):
                continue
            found = learnt(health, recorded.parameters)
            off = np.degrees([*found.edge_up, *found.edge_down]) - edges_of(
                made.sensors, made.parameters["hall_offset"]
            )
            assert np.abs(off).max() <= 3.0 * math.degrees(found.edge_sd)
            kept += 1
    assert kept >= 4


def too_coarse(health: Health, parameters: Mapping[str, float]) -> bool:
    """Whether its edges are not learned because its times are too coarse; never that the encoder slips."""
    try:
        learnt(health, parameters)
    except BenchError as error:
        return "a step of the times" in str(error)
    return False


def fooling(seed: int) -> Recording:
    """A drive that tells where its ring is, and one thing that is wrong with it or its encoder."""
    rng = np.random.default_rng((404, seed))
    motor = MOTORS[int(rng.integers(len(MOTORS)))]
    way = check(top_rpm(motor, str(rng.choice(["slow", "fast"]))), motor.n_p, again=bool(rng.random() < 0.7))
    lines, noise = int(rng.choice([500, 1024, 2500])), float(rng.choice([0.0, 0.3]))
    made = Recording(motor, way, encoder=Encoder(lines, noise=noise), voltages=bool(rng.random() < 0.7),
                     start=float(rng.random()), seed=seed)  # fmt: skip
    well = drawn(rng, motor.n_p, made.omega)
    made = telling_ring(made.but(sensors=replace(well, rise_late=NONE, fall_late=NONE)))
    stands = [seconds for seconds, rpm in way.knots if rpm == 0.0]
    match seed % 5:
        case 0:
            when = float(rng.uniform(0.3, stands[-2] - 0.3))
            return made.encoding(slips=((when, float(rng.uniform(0.3, 5.0) * rng.choice([-1.0, 1.0]))),))
        case 1:  # where the shaft turns round
            when = float(rng.choice(stands[2:-2]))
            return made.encoding(slips=((when, float(rng.uniform(0.3, 5.0) * rng.choice([-1.0, 1.0]))),))
        case 2:
            late = float(50e-6 * 20.0 ** rng.random())
            return made.sensing(rise_late=(late, late, late) if rng.random() < 0.5 else (late, 0.0, 0.0))
        case 3:
            return made.encoding(**{str(rng.choice(["lost", "gained"])): float(rng.uniform(0.02, 1.0))})
    return made.sensing(jitter=(float(rng.uniform(0.1, 3.0)),) * 3)


def edges_of(sensors: Sensors, offset: float) -> np.ndarray:
    """Ideal minus actual angle, deg (12,), upwards and downwards; `offset`: rad, of the edge that opens sector I."""
    magnets = np.array(sensors.magnets or (0.0, 0.0))
    off = np.zeros((2, 6))
    for k in range(3):
        for falls in (0, 1):
            ideal = -60.0 + 120.0 * k + 180.0 * falls
            apart = sensors.apart[k] * (2 * falls - 1)
            late = sensors.ring + sensors.displaced[k] + apart + magnets[falls::2].mean() - math.degrees(offset)
            half = np.array([0.5, -0.5]) * sensors.hysteresis[k]
            off[:, round(ideal / 60.0) % 6] = (180.0 - late - half) % 360.0 - 180.0
    return off.ravel()


# -- drives that will not have them -----------------------------------------------------------------------------


def nodes(device: SimulatedDevice) -> tuple[Node, Node]:
    client = Client(VirtualLink(device))
    return Node(client, client.connect().node), Node(client, LOAD)


SETTINGS = {"hall_offset": 0.5, "hall_swap_hat": 2.0, "hall_invert_hat": 7.0}
SOME = Learnt(
    (0.1, 0.2, 0.3, -0.1, -0.2, -0.3), (0.01, 0.02, 0.03, 0.04, 0.05, 0.06), 0.02, {"psi_f_hat": 0.007}, SETTINGS
)


def test_a_refusal_half_way_puts_back_what_was_there() -> None:
    device = simulated()
    drive, _ = nodes(device)
    write(drive, SOME)
    assert stored(device) == pytest.approx([*SOME.edge_up, *SOME.edge_down])
    beyond = Learnt((0.2,) * 6, (0.2, 0.2, 0.6, 0.2, 0.2, 0.2), 0.01, {}, dict.fromkeys(SETTINGS, 1.0))
    with pytest.raises(NodeError, match=r"edge_down_3 must be -0.506..0.506, got 0.6"):
        write(drive, beyond)
    assert stored(device) == pytest.approx([*SOME.edge_up, *SOME.edge_down])
    assert {name: device.bench.parameters[name] for name in SETTINGS} == SETTINGS


def test_a_device_without_the_parameters_is_left_alone() -> None:
    _, load = nodes(simulated())
    with pytest.raises(BenchError, match=r"^node 2 has no parameter 'edge_up_1'"):
        write(load, replace(SOME, settings={}))


# -- files ------------------------------------------------------------------------------------------------------


def test_a_toml_file_is_a_configuration_of_the_simulated_drive(tmp_path: Path) -> None:
    save(tmp_path / "edges.toml", SOME)
    firmware = load_params(tmp_path / "edges.toml").firmware
    edges = firmware.hall_edges
    assert ((edges.edge_sd, firmware.psi_f_hat), edges.edge_up) == ((0.02, 0.007), pytest.approx(SOME.edge_up))
    assert edges.edge_down == pytest.approx(SOME.edge_down)
    assert {name: getattr(firmware, name) for name in SETTINGS} == SETTINGS


def test_a_json_file_has_the_same_numbers_with_their_unit(tmp_path: Path) -> None:
    save(tmp_path / "edges.json", SOME)
    data = json.loads((tmp_path / "edges.json").read_text())
    edges = {"unit": "rad", "edge_up": list(SOME.edge_up), "edge_down": list(SOME.edge_down), "edge_sd": 0.02}
    assert data == {**edges, **SETTINGS, "psi_f_hat": 0.007}


def test_a_recording_is_learnt_into_a_file(learnable: Path, tmp_path: Path) -> None:
    out = tmp_path / "edges.json"
    main(["hall", "learn", str(learnable), "--out", str(out)])
    up = json.loads(out.read_text())["edge_up"]
    assert [math.degrees(value) for value in up] == pytest.approx(np.array(TABLE_I) - 0.25, abs=0.06)


# -- by a Kalman filter -----------------------------------------------------------------------------------------


def test_the_hosts_filter_learns_them_without_an_encoder(capsys: pytest.CaptureFixture[str]) -> None:
    """The oracle is the plant's own edges; it is no surer than it says."""
    device = simulated(encoder__present=0)
    learn(device, "--yes", "--by", "filter", "--speed", "1000", "--write")
    degrees, sd = np.degrees(stored(device)), math.degrees(device.bench.parameters["edge_sd"])
    off = degrees - np.concatenate([np.array(TABLE_I) - 0.25, np.array(TABLE_I) + 0.25])
    assert np.abs(off).max() < min(0.6, 2.0 * sd)
    assert sd < 2.0
    out = capsys.readouterr().out
    assert "13 parameters written to node 1 and read back" in out
    assert "the host's filter, on the recorded data" in out


def test_a_recording_is_learnt_by_the_filter_and_its_lessons_are_in_the_json(learnable: Path, tmp_path: Path) -> None:
    out = tmp_path / "lessons.json"
    main(["hall", "learn", str(learnable), "--by", "filter", "--json", str(out)])
    data = json.loads(out.read_text())
    assert data["outcome"] == "healthy"
    up = [math.degrees(data["lessons"][name]["value"]) for name in NAMES[:6]]
    assert up == pytest.approx(np.array(TABLE_I) - 0.25, abs=0.3)
    assert set(data["lessons"]) == {*NAMES, "psi_f_hat", "R_s_hat", "L_s_hat"}


BLIND = {
    f"firmware__protection__hall_{name}": value
    for name, value in (("fault_time", 1e3), ("fault_count", 1000), ("turns", 100), ("emf", 1e3))
}
"""A drive whose protection does not see its Hall sensors."""


def running(observer: int = 10, **settings: float) -> SimulatedDevice:
    """A drive that has been at work with its filter in control, both ways, at two loads, and is idle again."""
    device = simulated(firmware__observer=observer, **settings)
    bench = device.bench
    for state in (DriveState.ARMED, DriveState.RUNNING):
        bench.enter_state(state)
        bench.load_enter_state(state)
        bench.advance(1)
    for rpm, amps in ((1000, 1), (1500, 4), (600, 7), (-1000, 2), (-600, 6)):
        bench.load_setpoint(SetpointMode.SPEED, rpm * math.tau / 60)
        bench.setpoint(SetpointMode.CURRENT, amps)
        bench.advance(10_000)
    bench.enter_state(DriveState.IDLE)
    bench.load_enter_state(DriveState.IDLE)
    bench.advance(100)
    assert not bench.faults
    return device


def test_what_the_drives_own_filter_has_learned_is_read_written_and_kept(capsys, tmp_path) -> None:
    """Nothing is energised for it; a new drive begins with it."""
    store = tmp_path / "parameters.json"
    device = running()
    device.drive.app._store = store
    device.drive.identity = replace(device.drive.identity, features=device.drive.identity.features | Feature.COMMIT)
    link = WatchedLink(device)
    with patch("bench.rig.connection.open_link", lambda target: link):
        main(["hall", "learn", TARGET, "--by", "drive", "--motor", "--store"])
    assert set(link.states) == {DriveState.IDLE}
    out = capsys.readouterr().out
    assert "16 parameters written to node 1 and read back" in out
    assert "node 1 stored its parameters" in out
    truth = np.concatenate([np.array(TABLE_I) - 0.25, np.array(TABLE_I) + 0.25])
    again = SimulatedDevice(load_params(None), 1, store=store)
    assert np.degrees(stored(again)) == pytest.approx(truth, abs=0.3)
    assert 0.2 < math.degrees(again.bench.parameters["edge_sd"]) < 2.0
    for name, true in (("psi_f_hat", 6.55e-3), ("R_s_hat", 0.158), ("L_s_hat", 0.176e-3)):
        assert again.bench.parameters[name] == pytest.approx(true, rel=0.03)
        assert again.bench.parameters[name] != simulated().bench.parameters[name]


@pytest.mark.parametrize("by", ["drive", "filter"])
def test_a_filter_that_has_learned_little_says_how_little_and_nothing_is_written(by: str, capsys) -> None:
    device = simulated(firmware__hall_edges__learn_edges=0)
    err = refused(capsys, device, "--yes", "--by", by, "--write")
    assert re.search(r"no edges learned: the .* filter.* knows them to 6\.0 deg \(st", err)
    assert stored(device) == [0.0] * 12


def test_a_sensor_that_the_filter_does_not_believe_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    device = running(wiring__hall_open=2, **BLIND)
    assert "distrusts sensor b: run bench hall check" in refused(capsys, device, "--by", "drive", "--write")


def test_a_drive_without_a_store_is_told_so_before_anything_turns(capsys: pytest.CaptureFixture[str]) -> None:
    device = simulated()
    err = refused(capsys, device, "--yes", "--store")
    assert "bench hall learn --store needs the feature COMMIT; node 1 (simulated drive)" in err
    assert device.bench.n < 16_000


@pytest.mark.parametrize(("arguments", "words"), [
    (["--motor"], "the encoder does not measure motor parameters"),
    (["--by", "filter", "--passive"], "the filter needs voltages"),
])  # fmt: skip
def test_what_does_not_go_together_is_said_at_once(arguments: list[str], words: str, capsys) -> None:
    assert words in refused(capsys, simulated(), "--yes", *arguments)


def test_a_recording_without_what_the_drive_has_learned_says_how_to_record_it(capsys, learnable: Path) -> None:
    needed = "bench live --channels +lesson_ek,+lesson_value_ek,+lesson_sigma_ek,+sensors_ek"
    assert needed in refused(capsys, None, str(learnable), "--by", "drive")
