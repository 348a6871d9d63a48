"""An encoder's disc that is loose on the shaft: how far it slips, in closed form and in small steps."""

import math
from itertools import pairwise

import numpy as np
import pytest
from rig import Rig, error_deg

from protocol.messages import SetpointMode
from sim.plant import encoder

T = 1.0 / 16000.0


def loose(grip):
    params = encoder.make_params(3600, 0.0, 100.0, 6, 6, T)
    return encoder.make_faulty(params, 0.0, grip, 0.0, 0, 0)


@pytest.mark.parametrize("seed", range(6))
def test_the_disc_follows_its_friction_and_the_shaft(seed):
    """Against small steps of the same physics, of a shaft whose acceleration changes every millisecond."""
    rng = np.random.default_rng(seed)
    grip = rng.uniform(50.0, 500.0)
    params, disc = loose(grip), encoder.Disc(0.0, 0.0)
    speeds = np.concatenate([[0.0], np.cumsum(np.repeat(rng.normal(0.0, 3.0 * grip, 40), 16)) * T])
    omega, behind, n = 0.0, 0.0, 200
    for before, after in pairwise(speeds):
        disc = encoder.dragged(params, disc, float(before), float(after))
        for k in range(n):
            shaft = before + (after - before) * (k + 1) / n
            omega += np.clip(shaft - omega, -grip * T / n, grip * T / n)
            behind += (shaft - omega) * T / n
    assert abs(behind) > 1e-4
    assert disc.behind == pytest.approx(behind, abs=2e-6 + 2e-3 * abs(behind))
    assert disc.omega == pytest.approx(omega, abs=grip * T)


@pytest.mark.parametrize("rpm", [300.0, -600.0])
def test_it_lags_by_what_a_hard_start_has_more_than_friction_gives(rpm):
    """Half of the speed squared times 1 / grip - 1 / acceleration; a gentle start loses nothing."""
    grip, alpha = 400.0, 2000.0
    omega = abs(rpm) * math.tau / 60.0
    lost = {}
    for slope in (alpha, 300.0):
        rig = Rig(0, **{"faults.encoder.slip_alpha": grip, "load.alpha_m_max": slope})
        rig.load(SetpointMode.SPEED, rpm * math.tau / 60.0)
        lost[slope] = error_deg(rig.run(0.6), "theta_enc")[-1600:].mean()
    expected = math.copysign(math.degrees(6 * 0.5 * omega**2 * (1.0 / grip - 1.0 / alpha)), rpm)
    assert (lost[alpha] - expected + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=0.3)
    assert abs(lost[300.0]) < 0.1
    assert abs(expected) > 20.0
