"""The acceptance tests on a drive that has the parameters that a commissioning found, and knew nothing before."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest
from drawn_benches import NAMES, made
from test_commission_drive import all_of, found

from bench.commission.parameters import parameters_of
from bench.files import leaves
from sim.config.params import load_params
from sim.ports.device import SimulatedDevice
from sim.ports.virtual import VirtualLink
from tests.bench.accept.accepting import accepting_in


@pytest.mark.campaign("commission")
@pytest.mark.long("a commissioning and the whole acceptance")
@pytest.mark.parametrize("name", NAMES)
def test_what_was_found_is_accepted(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    of = made(name, hard=False)
    outcomes = all_of(of)
    values = {key: quantity.value for key, quantity in parameters_of(found(outcomes)).items()}
    values |= {key: value for outcome in outcomes.values() for key, value in outcome.settings.items()}

    def opened(config: Path | None, overrides: Mapping[str, float], seed: int) -> VirtualLink:
        device = SimulatedDevice(load_params(None, {**dict(leaves(of.config)), **overrides}), seed)
        app = device.sessions[0].app
        for parameter in app.parameters:
            if parameter.name in values:
                app.set_param(parameter.name, values[parameter.name])
        return VirtualLink(device)

    monkeypatch.setattr("sim.ports.virtual.open_virtual", opened)
    monkeypatch.chdir(tmp_path)
    with accepting_in(tmp_path) as accepting:
        run = accepting()
    assert {test: verdict for test, verdict in run.tests.items() if verdict != "PASS"} == {}
