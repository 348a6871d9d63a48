"""`bench conform` and what HBP 1.1 added: checks of a feature run where the device has it, and leave it as it was."""

from __future__ import annotations

from collections.abc import Iterable
from unittest.mock import patch

import numpy as np
import pytest
from conforming import ended, on_device, on_simulated
from virtual_run import at_rest, simulated

from bench.conform import run as conforming
from bench.conform.catalogue import checks, chosen
from bench.conform.checks import Check
from bench.conform.levels import MOTION, STATES, STREAMS
from bench.conform.run import Run
from bench.signal.verdict import Verdict
from protocol.messages import CaptureArm, CaptureState, CaptureTrigger
from sim.ports.device import SimulatedDevice

OF_FEATURES = {
    "capture.": "CAPTURE", "blob.meanings": "MEANINGS", "blob.w": "WAVEFORM", "stream.means": "MEANS",
    "motion.means": "MEANS", "commission.": "COMMISSION", "parameter.of-commissioning": "COMMISSION",
}  # fmt: skip
"""The feature of each check, by the beginning of its name."""
OTHERWISE = {
    "commission.volatile": "the device has no VOLATILE parameter that can be set",
    "commission.encoder-zero": "the device lacks the parameter encoder_zero, or an encoder's angle",
}
"""What is there without the feature, too, and why it is not here."""


def of_features() -> list[str]:
    """The names of the checks of features."""
    return [check.id for check in checks() if check.id.startswith(tuple(OF_FEATURES))]


def only(names: Iterable[str]) -> object:
    """Of all checks, these run."""

    def some(level: int, bus: bool) -> list[Check]:
        return [check for check in chosen(level, bus) if check.id in set(names)]

    return patch.object(conforming, "chosen", some)


def on_drive(level: int, names: Iterable[str], device: SimulatedDevice) -> Run:
    with only(names):  # type: ignore[attr-defined]
        return on_simulated(level, device)


@pytest.mark.parametrize("carrier", ["bytes", "CAN"])
def test_a_device_of_hbp_1_0_is_not_asked_for_what_it_lacks(carrier: str) -> None:
    names = {*of_features(), "link.unknown-type", "identity.other-blobs", "parameter.groups", "parameter.changes-told"}
    others = {check.id for check in checks()} - names
    run, device = on_device(MOTION, carrier=carrier, without=others)
    evidence = {result.check.id: result.evidence for result in run.results}
    for name in of_features():
        feature = next(feature for start, feature in OF_FEATURES.items() if name.startswith(start))
        assert evidence[name] == OTHERWISE.get(name, f"the device lacks the feature {feature}"), name
    assert set(ended(run, Verdict.SKIPPED)) == {*of_features(), "parameter.groups", "parameter.changes-told"}
    assert evidence["parameter.changes-told"] == "the device speaks HBP 1.0"
    for kind in ("BLOB_WRITE", "CAPTURE_ARM", "CAPTURE_STATUS"):
        assert f"{kind}: UNKNOWN_TYPE" in evidence["link.unknown-type"]
    for blob in (1, 2, 3, 4):
        assert f"blob {blob}: BLOB_READ: UNKNOWN_ID, detail {blob}" in evidence["identity.other-blobs"]
    assert ended(run, Verdict.PASS) == ["link.unknown-type", "identity.other-blobs"]
    assert device.seen["START"] == 0


@pytest.mark.long("all checks of features, while turning too")
def test_a_drive_is_left_as_it_was_and_waits_for_a_fault() -> None:
    device = simulated()
    device.bench.waveform[:3] = 7, -7, 77
    waveform, before = device.bench.waveform.copy(), dict(device.bench.parameters)
    run = on_drive(MOTION, of_features(), device)
    assert ended(run, Verdict.FAIL) == ended(run, Verdict.INVALID) == []
    assert len(ended(run, Verdict.PASS)) > 25
    assert at_rest(device)
    assert device.bench.parameters == before
    assert np.array_equal(device.bench.waveform, waveform)
    capture = device.drive.capture
    assert (capture.state, capture.trigger) == (CaptureState.ARMED, CaptureTrigger.FAULT)


def test_what_the_checks_of_faults_have_frozen_is_given_up() -> None:
    device = simulated()
    run = on_drive(STATES, ["watchdog.trips", "state.stop-obeyed"], device)
    assert len(ended(run, Verdict.PASS)) == 2
    assert device.drive.capture.state == CaptureState.ARMED


def test_a_capture_that_is_held_is_left_for_whoever_wants_to_read_it() -> None:
    device = simulated()
    capture = device.drive.capture
    capture.arm(CaptureArm(CaptureTrigger.NOW, after=20, channels=(device.drive.app.channels[0].id,)), 512)
    device.advance(200)
    assert capture.state == CaptureState.FROZEN
    number, blob = capture.number, capture.blob
    names = [name for name in of_features() if name.startswith("capture.")]
    run = on_drive(STREAMS, names, device)
    assert ended(run, Verdict.INVALID) == [result.check.id for result in run.results]
    for result in run.results:
        assert result.evidence == f"capture {number} was held when this began: read it, or give it up"
    assert (capture.state, capture.number, capture.blob) == (CaptureState.FROZEN, number, blob)
