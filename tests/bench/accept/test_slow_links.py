"""Acceptance tests where the link is too slow for samples: what they measure comes out of the drive's memory."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from accepting import Accepting
from uart import Uart

import bench.accept
from bench.errors import BenchError
from bench.rig.rig import Plan, Rig
from protocol.canmap.frame import BusRates
from protocol.messages import CaptureState, Fault
from sim.config.params import load_params
from sim.ports.device import SimulatedDevice
from sim.ports.networks import CanNetwork, Network
from sim.ports.virtual import VirtualLink

STEP = 0.005  # s of virtual time between looks for bytes
LINKS: dict[str, Callable[[], Network]] = {
    "CAN 500 kbit/s": lambda: CanNetwork(BusRates(500_000)),
    "UART 115200": lambda: Uart(115_200),
}
SUITE = Path(bench.accept.__file__).with_name("suite")
TESTS = sorted(
    {name for file in SUITE.glob("test_*.py") for name in re.findall(r"^def (test_\w+)", file.read_text(), re.M)}
)
SEED = 5
SLOW = pytest.mark.long("hundreds of kilobytes over a slow link, frame by frame")


def slow(kind: str, seed: int = SEED, **settings: object) -> VirtualLink:
    overrides = {key.replace("__", "."): value for key, value in settings.items()}
    return VirtualLink(SimulatedDevice(load_params(None, overrides), seed, network=LINKS[kind]()), step=STEP)  # type: ignore[arg-type]


@contextmanager
def rig_on(link: VirtualLink, **prepared: object) -> Iterator[Rig]:
    with Rig(Plan(lambda: link, "sim", virtual=True)).prepare(held=True, **prepared) as rig:  # type: ignore[arg-type]
        yield rig


@SLOW
@pytest.mark.parametrize("kind", LINKS)
def test_what_is_recorded_is_every_period_although_the_link_carries_few(kind) -> None:
    link = slow(kind)
    with rig_on(link) as rig:
        assert rig.samples is not None
        assert rig.samples.rate < 0.1 * link.device.pwm_hz == 0.1 * rig.rate
        rig.drive.start("encoder")
        rig.drive.speed(rpm=600)
        rig.wait(0.5)
        run = rig.record(0.1)
        assert set(np.diff(run.samples.index)) == {1}
        assert run.span[1] - run.span[0] == pytest.approx(0.1, abs=1e-4)
        assert not run.flaws()
        speed = run["omega_enc"].mean() / 6 / (2 * np.pi) * 60
        assert speed == pytest.approx(600, rel=0.01)
        angle = np.unwrap(run["theta_enc"])
        assert (angle[-1] - angle[0]) / 0.1 == pytest.approx(run["omega_enc"].mean(), rel=2e-3)
        assert len(run.edges) == pytest.approx(6 * 6 * 600 / 60 * 0.1, abs=1)

        with rig.recording(0.3) as stretch:
            rig.wait(0.1)
            rig.drive.speed(rpm=900)
            with rig.drive.tuning(k_p_vt=900.0):
                rig.wait(0.2)
            with pytest.raises(BenchError, match="this one goes on: end it before the next"):
                rig.record(0.01)
        step = stretch.capture
        assert step.parameters["k_p_vt"] == 1268.0
        assert [(change.name, change.value) for change in step.parameters.changes] == [
            ("k_p_vt", 900.0), ("k_p_vt", 1268.0)
        ]  # fmt: skip
        assert (step.samples.tick[0], step.samples.tick[-1]) == pytest.approx((stretch.first, stretch.last), abs=2500)
        assert step["omega_ref"][0] < step["omega_ref"][-1] if "omega_ref" in step else True
        assert not step.flaws()
        assert rig.streamed(0.05).rate == rig.samples.rate
        assert rig.drive.faults == ()  # its watchdog was fed all the time
        rig.drive.stop()
    capture = link.device.drive.capture
    assert (capture.state, capture.trigger.name) == (CaptureState.ARMED, "FAULT")


@SLOW
def test_a_stretch_beyond_the_memory_is_slower_or_refused_or_known_to_lack_its_end() -> None:
    memory = 60_000  # bytes
    with rig_on(slow("CAN 500 kbit/s", memory__capture=memory)) as rig:
        run = rig.record(0.5)
        assert 1 < run.samples.config.decimation < 16
        assert set(np.diff(run.samples.index)) == {run.samples.config.decimation}
        assert not run.flaws()
        with rig.recording(0.1) as stretch:
            rig.wait(1.0)
        (flaw,) = [words for words in stretch.capture.flaws() if "memory held no sample after" in words]
        assert "give record.stretch() its length" in flaw
    with rig_on(slow("CAN 500 kbit/s", memory__capture=memory), full=True) as rig:
        with pytest.raises(BenchError, match=f"do not fit into the drive's {memory} bytes for captures"):
            rig.record(0.5)
        assert rig.record(0.02).rate == rig.rate


@SLOW
def test_a_trip_in_a_stretch_is_in_what_was_held() -> None:
    link = slow("CAN 500 kbit/s")
    with rig_on(link) as rig:
        rig.drive.start("encoder")
        rig.drive.speed(rpm=300)
        with rig.drive.may_trip(), rig.recording(0.4) as stretch:
            rig.wait(0.1)
            link.device.drive.fault(Fault.OVERVOLTAGE)
            tripped = link.device.tick
            rig.wait(0.2)
        run = stretch.capture
        state = run["status"].astype(int) & 7
        at = int(run.samples.tick[int(np.argmax(state == state[-1]))])
        assert abs(at - tripped) < 5 * run.samples.config.period_ticks
        rig.drive.forget_faults()
        assert rig.record(0.01).rate == rig.rate  # the drive held its trip: that is given up for the next
    assert link.device.drive.capture.trigger.name == "FAULT"


def test_what_the_drive_still_holds_is_not_given_up_unasked() -> None:
    link = slow("CAN 500 kbit/s", memory__capture=16_384)
    link.device.drive.fault(Fault.HALL)
    link.device.advance(4000)
    link.device.drive.machine.command(*_cleared(link))
    assert link.device.drive.capture.state == CaptureState.FROZEN
    with pytest.raises(BenchError, match="it holds one: fetch it with `bench capture sim --at-fault"):
        Rig(Plan(lambda: link, "sim", virtual=True)).prepare(held=True)
    assert link.device.drive.capture.state == CaptureState.FROZEN


def _cleared(link: VirtualLink) -> tuple[object, int, int]:
    from protocol.messages import Command

    return Command.FAULT_CLEAR, int(Fault.HALL), link.device.tick


@pytest.mark.campaign("slow-links")
@pytest.mark.parametrize("kind", LINKS)
@pytest.mark.parametrize("test", TESTS)
def test_an_acceptance_test_has_the_verdicts_that_it_has_on_a_fast_link(
    kind: str, test: str, accepting: Accepting, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = accepting(keyword=test, seed=SEED).tests

    def opened(config: object, overrides: dict[str, object], seed: int) -> VirtualLink:
        return VirtualLink(
            SimulatedDevice(load_params(config, overrides), seed, network=LINKS[kind]()),
            step=STEP,  # type: ignore[arg-type]
        )

    monkeypatch.setattr("sim.ports.virtual.open_virtual", opened)
    assert accepting(keyword=test, seed=SEED).tests == wanted
