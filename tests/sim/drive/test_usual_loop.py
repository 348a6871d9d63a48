"""The loop that knows what most benches have not, against the one for all benches."""

import pytest
from rig import Rig, loop_records

from protocol.messages import SetpointMode
from protocol.signals import Status
from sim.drive import tick

RARE = {
    "dc_link.R_source": 0.05,
    "motor.L_q": 200e-6,
    "coupling.stiffness": 50.0,
    "encoder.latency": 20e-6,
    "current_sensor.delay": 1e-6,
    "hall.latency": 10e-6,
    "clock.substeps": 2,
    "link_sensor.gain_error": 0.01,
    "motor.i_cross": 60.0,
    "motor.iron_eddy": 1e-5,
    "motor.iron_hysteresis": 1e-3,
    "motor.skin_R": 0.05,
    "mechanics.stribeck": 1e-3,
    "faults.motor.open": 1,
    "faults.motor.swap": 1,
    "faults.motor.short": 1,
    "faults.encoder.slip_alpha": 100.0,
}


def run(general):
    """Up to speed, with the sensors' wires disturbed for a while: both loops, one after the other."""
    rig, parts, loops = Rig(7), [], []
    rig.start()
    for name, value in (("hall_glitch", 0.0), ("hall_glitch", 300.0), ("hall_glitch", 0.0)):
        rig.set_load_param(name, value)
        if general:
            rig._advance = tick.advance
        loops.append(rig._advance)
        parts.append(rig.advance(700) if parts else rig.spin(300.0, 0.1, 0.05))
    return loops, [*loop_records(parts), *(part.captured.tobytes() for part in parts)]


def test_both_loops_agree_bit_for_bit_and_one_takes_over_from_the_other():
    loops, found = run(general=False)
    assert loops == [tick.advance_usual, tick.advance, tick.advance_usual]
    assert found == run(general=True)[1]


@pytest.mark.parametrize("mode", [SetpointMode.SPEED, SetpointMode.CURRENT])
def test_a_test_signal_of_no_size_changes_no_bit_but_the_one_of_its_cycles(mode):
    found = []
    for kind in (0.0, 3.0, 5.0):
        rig = Rig(7)
        rig.start()
        rig.spin(200.0, 0.2, 0.05)
        rig.set_param("test", kind)
        assert rig._advance is (tick.advance if kind else tick.advance_usual)
        rig.setpoint(mode, 2.0)
        run = rig.advance(900)
        assert bool((run.samples["status"] & Status.INJECTION_SYNC).any()) == bool(kind)
        found.append([run[name].tobytes() for of in tick.RECORDS for name in of._fields if name != "status"])
    assert found[0] == found[1] == found[2]


@pytest.mark.parametrize(("name", "value"), RARE.items(), ids=RARE)
def test_a_rarer_effect_takes_the_loop_that_has_it(name, value):
    assert Rig()._advance is tick.advance_usual
    assert Rig(**{name: value})._advance is tick.advance
