"""The simulated bench behind its link: identity, parameters, states, watchdog to the millisecond, faults, store."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from small_host import SmallHost

from protocol.errors import Refused
from protocol.messages import (
    Alive,
    Command,
    DriveState,
    ErrorCode,
    EventCode,
    Fault,
    Feature,
    ParamCommit,
    Role,
    SetpointMode,
)
from protocol.signals import (
    DRIVE_CHANNELS,
    DRIVE_PARAMETERS,
    LOAD_CHANNELS,
    LOAD_PARAMETERS,
    STATUS_STATE_MASK,
    AngleSource,
    Flag,
)
from sim.config.params import BenchParams, ConfigError, load_params
from sim.ports.device import SimulatedDevice
from sim.ports.virtual import VirtualLink

PARAMS = load_params()


def make(params: BenchParams = PARAMS, **arguments: object) -> tuple[SmallHost, SimulatedDevice]:
    device = SimulatedDevice(params, **arguments)  # type: ignore[arg-type]
    return SmallHost(VirtualLink(device, step=0.002)), device


@contextmanager
def refused(code: ErrorCode, detail: float | None = None) -> Iterator[None]:
    with pytest.raises(Refused) as caught:
        yield
    assert caught.value.code == code
    assert detail in (None, caught.value.detail)


def test_both_nodes_say_who_they_are_and_what_they_have() -> None:
    host, _ = make()
    drive, load = host.connect(), host.nodes[2].identity
    assert (drive.node, drive.role, drive.name, drive.serial) == (1, Role.DRIVE, "simulated drive", "SIM-0001")
    assert (load.node, load.role, load.name, load.serial) == (2, Role.LOAD, "load machine", "SIM-0002")
    assert drive.firmware == load.firmware == "hallbench-sim"
    assert re.fullmatch(re.escape(version("hallbench")) + "-[0-9a-f]{12}", drive.build)
    assert drive.build == load.build == make(seed=9)[0].connect().build
    assert drive.nodes == load.nodes == 2
    assert drive.boot_id == load.boot_id
    assert (drive.tick_hz, drive.pwm_hz, drive.ticks_per_period) == (20_000_000, 16_000, 1250)
    assert drive.features == Feature.EDGES | Feature.SIMULATED | Feature.COMMISSION
    assert load.features == Feature.SIMULATED
    assert drive.state is DriveState.IDLE
    for hello, channels, parameters in (
        (drive, DRIVE_CHANNELS, DRIVE_PARAMETERS),
        (load, LOAD_CHANNELS, LOAD_PARAMETERS),
    ):
        descriptor = host.nodes[hello.node].descriptor
        assert [c.name for c in descriptor.channels] == [c.name for c in channels]
        assert [p.name for p in descriptor.parameters] == [p.name for p in parameters]
        assert hello.schema_crc == descriptor.crc


def test_boot_id_follows_the_seed() -> None:
    ids = [make(seed=seed)[0].connect().boot_id for seed in (1, 1, 2)]
    assert ids[0] == ids[1] != ids[2]
    assert make(boot_id=77)[0].connect().boot_id == 77


def test_parameters_are_those_of_the_configuration_as_float32() -> None:
    host, device = make(load_params(None, {"firmware.vector_tracking.k_p_vt": 1000.1}))
    reply = host.get("k_p_vt")
    assert reply.value == reply.default == float(np.float32(1000.1))
    assert host.set("k_p_vt", 900.1) == float(np.float32(900.1)) == device.bench.parameters["k_p_vt"]
    assert host.get("k_p_vt").default == reply.value
    assert host.set("tau_max", 0.5, node=2) == 0.5
    assert host.get("tau_max", node=2).value == 0.5


def test_the_range_of_the_current_sensors_is_told_and_not_set(tmp_path: Path) -> None:
    store = tmp_path / "drive.json"
    host, _ = make(load_params(None, {"current_sensor.range": 15.0}), store=store)
    assert host.get("i_range").value == 15.0
    with refused(ErrorCode.READ_ONLY):
        host.set("i_range", 20.0)
    host.request(ParamCommit())
    host, _ = make(load_params(None, {"current_sensor.range": 10.0}), store=store)
    assert host.get("i_range").value == 10.0


def test_a_drive_without_an_encoder_has_no_channels_nor_control_by_it(tmp_path: Path) -> None:
    store = tmp_path / "drive.json"
    host, _ = make(load_params(None, {"encoder.present": 0}), store=store)
    names = [channel.name for channel in host.nodes[1].descriptor.channels]
    assert names == [c.name for c in DRIVE_CHANNELS if c.name not in ("theta_enc", "omega_enc")]
    assert "theta_true" in names
    assert host.get("observer").lo == AngleSource.AVERAGE_SPEED
    with refused(ErrorCode.OUT_OF_RANGE, AngleSource.AVERAGE_SPEED):
        host.set("observer", AngleSource.ENCODER)
    store.write_text('{"observer": 0}')
    with pytest.raises(ConfigError, match=f"observer must be between 1 and {max(AngleSource):d}, got 0"):
        make(load_params(None, {"encoder.present": 0}), store=store)


def test_samples_without_an_encoder_are_those_with_one_but_for_its_columns() -> None:
    chunks, edges = [], []
    for present in (0, 1):
        host, _ = make(load_params(None, {"encoder.present": present}), seed=3)
        names = [c.name for c in DRIVE_CHANNELS if c.name not in ("theta_enc", "omega_enc")]
        host.stream(names)
        host.start()
        host.setpoint(SetpointMode.SPEED, 50.0)
        host.run(0.2)
        chunks.append(host.samples().raw)
        edges.append(host.edges().encoder)
    n = min(map(len, chunks))
    assert n > 1000
    assert np.array_equal(chunks[0][:n], chunks[1][:n])
    assert not edges[0].any()
    assert edges[1].any()


def test_faults_are_put_on_the_wires_while_the_drive_runs() -> None:
    host, device = make()
    host.start()
    host.setpoint(SetpointMode.SPEED, 20.0)
    host.run(0.4)
    assert device.bench.truth.omega_m == pytest.approx(20.0, abs=1.0)
    assert host.heartbeats[1].outputs_on
    assert host.set("hall_open", 2, node=2) == 2
    host.run(0.3)
    assert host.heartbeats[1].faults == Fault.HALL
    assert not device.bench.outputs_on
    host.set("hall_open", 0, node=2)
    host.run(0.1)
    assert host.command(Command.FAULT_CLEAR, Fault.HALL) is DriveState.IDLE


def test_how_the_hall_sensors_sit_and_are_wired_is_said_while_nothing_runs() -> None:
    host, device = make()
    host.start()
    before = {name: device.bench.parameters[name] for name in ("hall_offset", "hall_swap_hat", "hall_invert_hat")}
    for name in before:
        with refused(ErrorCode.WRONG_STATE):
            host.set(name, 1.0)
    assert {name: device.bench.parameters[name] for name in before} == before
    host.command(Command.STOP)
    for name, most in (("hall_offset", float(np.float32(math.pi))), ("hall_swap_hat", 5.0), ("hall_invert_hat", 7.0)):
        assert host.set(name, most) == device.bench.parameters[name] == most
        with refused(ErrorCode.OUT_OF_RANGE):
            host.set(name, most + 1.0)
    with refused(ErrorCode.BAD_VALUE):
        host.set("hall_invert_hat", 0.5)


@pytest.mark.parametrize("node", [1, 2])
def test_watchdog_switches_off_to_the_millisecond(node: int) -> None:
    lines: list[str] = []
    device = SimulatedDevice(PARAMS, notice=lines.append)
    host = SmallHost(VirtualLink(device))
    host.stream(["status"], node, edges=False)
    host.start(node)
    session = device.sessions[node - 1]
    host.session.send(Alive(1), node)
    host.link.write(host.session.data_to_send())
    fed = device.tick
    device.advance(round(0.199 * 16000))
    assert session.state is DriveState.RUNNING
    device.advance(16000)  # at once
    assert session.state is DriveState.FAULT
    assert session.machine.faults is Fault.WATCHDOG
    assert not session.app.outputs_on
    host.poll()
    status = host.samples(node)
    off = status.tick[np.argmax(status.raw["status"] & STATUS_STATE_MASK == DriveState.FAULT)] - fed
    assert 0.200 * 20e6 <= off <= 0.202 * 20e6
    assert re.fullmatch(r"outputs off 20[0-2] ms after the last ALIVE: watchdog \(node ., .*\)", lines[-1])


@pytest.mark.parametrize(
    ("node", "mode", "value", "value2", "error"),
    [
        (1, SetpointMode.SPEED, 330.0, 0.0, None),
        (1, SetpointMode.SPEED, -331.0, 0.0, ErrorCode.OUT_OF_RANGE),
        (1, SetpointMode.SPEED, 331.0, 0.0, ErrorCode.OUT_OF_RANGE),
        (1, SetpointMode.CURRENT, 8.0, 0.0, None),
        (1, SetpointMode.CURRENT, 0.0, -8.0, None),
        (1, SetpointMode.CURRENT, 8.1, 0.0, ErrorCode.OUT_OF_RANGE),
        (1, SetpointMode.CURRENT, 6.0, -6.0, ErrorCode.OUT_OF_RANGE),
        (1, SetpointMode.CURRENT, math.nan, 0.0, ErrorCode.BAD_VALUE),
        (1, SetpointMode.TORQUE, 0.1, 0.0, ErrorCode.NOT_SUPPORTED),
        (2, SetpointMode.TORQUE, -1.0, 0.0, None),
        (2, SetpointMode.TORQUE, 1.1, 0.0, ErrorCode.OUT_OF_RANGE),
        (2, SetpointMode.SPEED, 350.0, 0.0, None),
        (2, SetpointMode.SPEED, 351.0, 0.0, ErrorCode.OUT_OF_RANGE),
        (2, SetpointMode.CURRENT, 1.0, 0.0, ErrorCode.NOT_SUPPORTED),
    ],
)
def test_setpoints_are_taken_up_to_their_limits_and_change_nothing_beyond(
    node: int, mode: SetpointMode, value: float, value2: float, error: ErrorCode | None
) -> None:
    host, device = make()
    host.start(node)
    before = (device.bench._drive, device.bench._load)
    host.setpoint(mode, value, value2, node)
    host.run(0.15)
    taken = (device.bench._drive, device.bench._load) != before
    rejected = [arg for code, arg in host.codes(node) if code == EventCode.SETPOINT_REJECTED]
    beat = host.heartbeats[node]
    if error is None:
        assert (taken, rejected, beat.setpoints_rejected, beat.setpoint_counter) == (True, [], 0, 1)
    else:
        assert (taken, rejected, beat.setpoints_rejected) == (False, [float(error)], 1)


def test_overspeed_of_the_machine_becomes_a_latched_fault() -> None:
    params = load_params(None, {"firmware.protection.omega_m_trip": 30.0})
    lines: list[str] = []
    host, device = make(params, notice=lines.append)
    host.start()
    host.setpoint(SetpointMode.CURRENT, 4.0)
    host.run(0.3)
    assert device.drive.state is DriveState.FAULT
    assert device.drive.machine.first_fault is Fault.OVERSPEED
    assert (EventCode.FAULT, float(Fault.OVERSPEED)) in host.codes()
    assert "outputs off: OVERSPEED (node 1, simulated drive)" in lines
    with refused(ErrorCode.FAULTS_CHANGED):
        host.command(Command.FAULT_CLEAR, Fault.WATCHDOG)
    host.run(1.0)  # coast down
    assert host.command(Command.FAULT_CLEAR, Fault.OVERSPEED) is DriveState.IDLE
    host.run(0.05)
    assert device.drive.state is DriveState.IDLE


def test_a_fault_whose_cause_stays_is_not_cleared() -> None:
    host, device = make(load_params(None, {"inverter.u_dc": 10.0, "firmware.protection.u_dc_min": 12.0}))
    host.start()
    host.run(0.02)
    assert device.drive.machine.faults is Fault.UNDERVOLTAGE
    with refused(ErrorCode.FAULT_PERSISTS, Fault.UNDERVOLTAGE):
        host.command(Command.FAULT_CLEAR, Fault.UNDERVOLTAGE)
    assert device.drive.state is DriveState.FAULT


@pytest.mark.parametrize("limit", ["lo", "hi"])
def test_every_parameter_takes_its_limits_and_keeps_them(tmp_path: Path, limit: str) -> None:
    store = tmp_path / "drive.json"
    host, device = make(store=store)
    assert host.connect().features & Feature.COMMIT
    default = host.get("k_p_vt").default
    stored = {}
    for parameter in DRIVE_PARAMETERS:
        if not parameter.flags & (Flag.READ_ONLY | Flag.VOLATILE):  # the volatile are limited by others: SPEC 20
            stored[parameter.name] = value = getattr(host.get(parameter.name), limit)
            assert host.set(parameter.name, value) == value
            device.advance(2)
    host.request(ParamCommit())
    host, _ = make(store=store)
    assert {name: host.get(name).value for name in stored} == stored
    assert host.get("k_p_vt").default == default  # of the configuration
    assert [path.name for path in tmp_path.iterdir()] == ["drive.json"]


def test_commit_without_a_store_or_a_place_to_write_is_refused(tmp_path: Path) -> None:
    for store, expected in (
        (None, ErrorCode.NOT_SUPPORTED),
        (tmp_path / "none" / "drive.json", ErrorCode.STORE_FAILED),
    ):
        host, _ = make(store=store)
        with refused(expected):
            host.request(ParamCommit())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rubbish", "cannot read the parameters in"),
        ("[]", "holds no parameters"),
        (json.dumps({"R_s": 1.0}), "unknown parameter R_s"),
        (json.dumps({"i_max": -1.0}), "i_max must be between 0 and 200, got -1.0"),
        (json.dumps({"i_max": True}), "got True"),
        (json.dumps({"n_p": 3.5}), "n_p must be a whole number, got 3.5"),
    ],
)
def test_a_bad_store_is_named(tmp_path: Path, text: str, message: str) -> None:
    store = tmp_path / "drive.json"
    store.write_text(text)
    with pytest.raises(ConfigError, match=message):
        make(store=store)


def test_frames_sent_are_whole_frames_however_the_bytes_are_cut() -> None:
    host, device = make()
    host.stream()
    device.data_to_send()
    before = device.network.frames_sent
    device.advance(1600)
    data = b""
    while part := device.data_to_send(37):
        data += part
    assert device.network.frames_sent - before == data.count(0) // 2 > 10
