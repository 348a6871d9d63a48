"""Faults of Hall sensors, magnets, shaft and encoder: what is captured, against formulas on the plant's own angle."""

import numpy as np
import pytest
from rig import PWM_HZ, RPM, Rig, column, error_deg

from protocol.messages import SetpointMode
from sim.config.params import ConfigError, load_params

TICK_HZ, PERIOD, COUNTS, N_P = 20e6, 1250, 14_400, 6
PLAIN = {"hall.delta_deg": [0.0] * 6, "hall.hysteresis_deg": 0.0, "hall.jitter_deg": 0.0, "load.alpha_m_max": 0.0,
         "mechanics.theta_0_deg": 30.0, "current_sensor.noise_rms": 0.0}  # fmt: skip
PATIENT = {"firmware.observer": 0, "firmware.protection.hall_fault_count": 1000,
           "firmware.protection.hall_fault_time": 10.0}  # fmt: skip
RISES, FALLS = (300.0, 60.0, 180.0), (120.0, 240.0, 0.0)  # where the sensors a, b, c become 1 and 0, forward, deg


def faulty(**settings):
    return {**PLAIN, **{f"faults.{key.replace('__', '.')}": value for key, value in settings.items()}}


def turned(rpm, seconds, seed=0, **settings):
    """What is recorded at a steady speed, from the second sample on: the angle is a straight line over time."""
    rig = Rig(seed, **{**PLAIN, **settings})
    rig.load(SetpointMode.SPEED, rpm * RPM)
    rig.advance(2)
    return rig.run(seconds)


def line(run):
    """Ticks of the first sample, its angle and the slope: rad, rad a tick."""
    theta = column(run, "theta_e")
    return run.tick, theta[0], (theta[-1] - theta[0]) / (PERIOD * (len(theta) - 1))


def passed(run, degrees):
    """Ticks, not whole, at which the rotor is at an electrical angle, within the run."""
    tick, theta, slope = line(run)
    ends = np.sort([theta, theta + slope * PERIOD * (len(run) - 1)])
    first, last = (ends - np.radians(degrees)) / (2 * np.pi)
    at = np.radians(degrees) + 2 * np.pi * np.arange(np.ceil(first), np.floor(last) + 1)
    return np.sort(tick + (at - theta) / slope)


def edges_of(run, sensor):
    """Ticks and new levels of an input's edges."""
    old, new = run.edges["codes"] & 7, run.edges["codes"] >> 3 & 7
    mine = ((old ^ new) >> sensor & 1).astype(bool)
    return run.edge_tick[mine], new[mine] >> sensor & 1


def in_order(run):
    old, new = run.edges["codes"] & 7, run.edges["codes"] >> 3 & 7
    return np.all(np.diff(run.edge_tick) >= 0) and np.array_equal(old[1:], new[:-1])


def assert_ticks(found, expected):
    """Of edges: each at the first tick after its moment. Those at the ends of the run may be in it or not."""
    inner = expected[2:-2]
    at = np.searchsorted(found, inner - 1.0)
    late = found[at] - inner
    assert len(inner) > 5
    assert abs(len(found) - len(expected)) <= 2
    assert late.min() > -0.51
    assert late.max() < 1.51


@pytest.mark.parametrize("rpm", [240.0, -3000.0])
def test_rising_and_falling_edges_of_each_sensor_come_late_by_its_delays(rpm):
    """Also by more than a sector, 556 us at 3000 r/min: edges of the others come in between, in order."""
    rise, fall = [150e-6, 0.0, 800e-6], [66e-6, 700e-6, 0.0]
    run = turned(rpm, 0.5, **faulty(hall__rise_delay=rise, hall__fall_delay=fall))
    assert in_order(run)
    for sensor in range(3):
        ticks, levels = edges_of(run, sensor)
        up, down = (RISES, FALLS) if rpm > 0 else (FALLS, RISES)
        assert_ticks(ticks[levels == 1], passed(run, up[sensor]) + rise[sensor] * TICK_HZ)
        assert_ticks(ticks[levels == 0], passed(run, down[sensor]) + fall[sensor] * TICK_HZ)
    tick, theta, slope = line(run)  # the encoder is latched when the edge comes, not where the sensor's edge lies
    counts = (theta + slope * (run.edge_tick - tick)) / (2 * np.pi * N_P) * COUNTS
    off = (run.edges["encoder"] - counts + COUNTS / 2) % COUNTS - COUNTS / 2
    assert np.abs(off + 0.5).max() < 0.6


def test_a_level_that_is_shorter_than_the_delay_into_it_never_comes():
    """Half a turn takes 1.67 ms at 3000 r/min; an RC element with a comparator does not rise, or fall, in it."""
    run = turned(3000.0, 0.3, **faulty(hall__rise_delay=[2e-3, 0.0, 1.6e-3], hall__fall_delay=[0.0, 2e-3, 0.0]))
    settled = run.samples["hall"][100:]
    assert not np.any(settled & 1)
    assert np.all(settled & 2)
    ticks, levels = edges_of(run, 2)
    assert_ticks(ticks[levels == 1], passed(run, RISES[2]) + 1.6e-3 * TICK_HZ)
    assert_ticks(ticks[levels == 0], passed(run, FALLS[2]))


def test_edges_bounce_as_often_and_as_far_apart_as_asked_for():
    run = turned(
        200.0, 10.0,
        **faulty(hall__bounce=[0.0, 1.0, 0.3], hall__bounce_returns=3, hall__bounce_spacing=30e-6,
                 hall__fall_delay=[0.0, 66e-6, 0.0]),
    )  # fmt: skip
    assert in_order(run)
    assert len(edges_of(run, 0)[0]) == pytest.approx(2 * 200 / 60 * 6 * 10, abs=2)
    ticks, levels = edges_of(run, 1)
    first = np.flatnonzero(np.diff(ticks, prepend=-1e9) > 2 * 600)[:-1]
    assert_ticks(ticks[first][levels[first] == 1], passed(run, RISES[1]))
    assert_ticks(ticks[first][levels[first] == 0], passed(run, FALLS[1]) + 66e-6 * TICK_HZ)
    for k in range(1, 7):  # back and there again, three times
        assert np.array_equal(ticks[first + k] - ticks[first], np.full(len(first), 600 * k))
        assert np.array_equal(levels[first + k], levels[first] ^ k & 1)
    ticks, _ = edges_of(run, 2)
    begins = np.flatnonzero(np.diff(ticks, prepend=-1e9) > 2 * 600)
    changes = np.diff(begins, append=len(ticks))
    assert set(changes[:-1]) == {1, 7}
    n = len(changes)
    assert np.sum(changes > 1) == pytest.approx(0.3 * n, abs=4 * np.sqrt(0.3 * 0.7 * n))


def pulses(run, sensor, level):
    """Begin and end of what differs from an input's level at rest, s."""
    ticks, levels = edges_of(run, sensor)
    begin, end = ticks[levels != level] / TICK_HZ, ticks[levels == level] / TICK_HZ
    n = min(len(begin), len(end))
    return begin[:n], end[:n]


def test_pulses_have_their_rate_and_widths_on_the_inputs_that_are_told():
    rig = Rig(5, **faulty(hall__pulse_rate=[300.0, 0.0, 40.0], hall__pulse_min=2e-4, hall__pulse_max=3e-3))
    run = rig.run(40.0)  # at rest: a is 1, b and c are 0
    assert in_order(run)
    assert len(edges_of(run, 1)[0]) == 0
    for sensor, level, rate in ((0, 1, 300.0), (2, 0, 40.0)):
        begin, end = pulses(run, sensor, level)
        width = end - begin
        busy = rate * 1.6e-3  # no pulse begins in one: a renewal process, of less scatter than a Poisson process
        assert len(begin) == pytest.approx(40 * rate, abs=4 * np.sqrt(40 * rate))
        assert 2e-4 <= width.min() < 2.5e-4
        assert 2.9e-3 < width.max() <= 3.0001e-3
        assert width.mean() == pytest.approx(1.6e-3, abs=4 * 2.8e-3 / np.sqrt(12 * len(width)))
        gap = begin[1:] - end[:-1]
        mean = (1 - busy) / rate
        assert gap.mean() == pytest.approx(mean, abs=4 * mean / np.sqrt(len(gap)))
        assert np.mean(gap > 2 * mean) == pytest.approx(np.exp(-2), abs=4 * np.sqrt(0.12 / len(gap)))


def test_pulses_may_come_with_the_current_and_then_are_as_many_as_it_is_large():
    rig = Rig(1, **faulty(hall__pulse_rate=[0.0, 400.0, 0.0], hall__pulse_by=1) | PATIENT)
    rig.start()
    for i_q in (0.0, 2.0, 6.0):
        rig.forced(120.0, i_q, 0.1)
        run = rig.forced(120.0, i_q, 4.0)
        amplitude = np.hypot(run["i_alpha_true"], run["i_beta_true"]).mean()
        assert amplitude == pytest.approx(i_q, abs=0.5)
        expected = 400.0 * amplitude / 8.0 * 4.0  # i_max is 8 A; 4 s
        found = len(edges_of(run, 1)[0]) / 2 - 4.0 * 2.0 * N_P
        assert found == pytest.approx(expected, abs=4 * np.sqrt(expected) + 2)


def test_pulses_may_come_with_the_edges_of_the_pwm():
    """Without a voltage the legs are high in the middle half of a period: edges at a quarter and three quarters."""
    rig = Rig(2, **faulty(hall__pulse_rate=[0.0, 0.0, 500.0], hall__pulse_by=2) | PATIENT)
    assert len(rig.run(1.0).edges) == 0  # outputs off
    rig.start()
    rig.forced(0.0, 0.0, 0.1)
    run = rig.forced(0.0, 0.0, 20.0)
    begin, end = pulses(run, 2, 0)
    assert len(begin) == pytest.approx(1e4, abs=4 * np.sqrt(1e4) + 0.01 * 1e4)  # few periods are within a pulse
    assert np.all(end - begin > 19.9e-6)
    phase = (begin * TICK_HZ) % PERIOD / PERIOD
    assert np.abs(np.abs(phase - 0.5) - 0.25).max() < 0.01
    assert np.mean(phase < 0.5) == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize(("share", "stretch"), [(0.02, 1e-3), (0.5, 0.05), (0.99, 1e-4)])
def test_a_contact_is_open_for_its_share_of_the_time_in_stretches_of_that_mean(share, stretch):
    seconds = 40.0 if stretch > 0.01 else 10.0
    rig = Rig(4, **faulty(hall__contact_open=[0.9, share, 0.0], hall__contact_stretch=stretch))
    run = rig.run(seconds)  # at rest: a is 1 and stays so, b and c are 0
    assert {int(code) for code in run.samples["hall"]} <= {1, 3}
    begin, end = pulses(run, 1, 0)
    length = end - begin
    n = len(length)
    assert n == pytest.approx(seconds * share / stretch, rel=4.5 / np.sqrt(n))
    assert length.mean() == pytest.approx(stretch, rel=4 / np.sqrt(n))
    assert np.mean(length > stretch) == pytest.approx(np.exp(-1), abs=2 / np.sqrt(n))
    correlation = stretch * (1 - share)  # s, of the two states
    assert np.mean(run.samples["hall"] == 3) == pytest.approx(
        share, abs=4 * np.sqrt(2 * share * (1 - share) * correlation / seconds) + 1e-3
    )


def test_edges_and_what_happens_to_inputs_leave_noise_and_jitter_as_they_are():
    plain, other = (
        turned(300.0, 0.2, 3, **{"hall.jitter_deg": 0.1, "current_sensor.noise_rms": 0.02}, **settings)
        for settings in ({}, {"faults.hall.pulse_rate": [1e3, 0.0, 0.0], "faults.hall.bounce": [0.0, 0.5, 0.0]})
    )
    assert plain.samples["i_a"].tobytes() == other.samples["i_a"].tobytes()
    assert np.array_equal(edges_of(plain, 2)[0], edges_of(other, 2)[0])
    assert len(other.edges) > len(plain.edges) + 50


def places(run):
    """Sector that each edge opens forward or closes in reverse, and where it lies, deg from the ideal; unwrapped."""
    tick, theta, slope = line(run)
    at = np.degrees(theta + slope * (run.edge_tick - 0.5 - tick))
    number = np.round(at / 60.0).astype(int)
    return number, at - 60.0 * number


def test_each_sensor_has_its_own_hysteresis():
    hysteresis = np.array([2.0, 5.0, 0.0])
    sides = []
    for rpm in (120.0, -120.0):
        number, off = places(turned(rpm, 1.0, **faulty(hall__hysteresis_deg=list(hysteresis))))
        sides.append([off[number % 3 == 2 - sensor].mean() for sensor in range(3)])
    np.testing.assert_allclose(np.subtract(*sides), hysteresis, atol=0.02)
    np.testing.assert_allclose(np.mean(sides, axis=0), 0.0, atol=0.02)


def test_edges_move_with_the_temperature_of_the_housing():
    drift = np.array([0.1, 0.0, -0.05])
    warm = {"thermal.ambient": 60.0, "thermal.R_th_winding": 1.0, "faults.hall.drift_deg": list(drift)}
    number, off = places(turned(300.0, 1.0, **warm))  # 40 K above 20 degrees C, and no current
    for sensor in range(3):
        np.testing.assert_allclose(off[number % 3 == 2 - sensor], 40.0 * drift[sensor], atol=0.02)
    rig = Rig(
        0, **PLAIN | warm | {"thermal.R_th_housing": 10.0, "thermal.tau_housing": 0.5, "thermal.tau_winding": 0.5}
    )
    rig.start()
    rig.forced(300.0, 0.0, 0.1)
    rig.forced(300.0, 6.0, 4.0)
    number, off = places(rig.forced(300.0, 6.0, 0.2))
    kelvin = 40.0 + rig._warming.state.housing
    assert kelvin > 80.0
    np.testing.assert_allclose(off[number % 3 == 2][2:], kelvin * 0.1, atol=0.3)


@pytest.mark.parametrize("rpm", [180.0, -180.0])
def test_one_pole_pair_lies_off_by_its_angle(rpm):
    number, off = places(turned(rpm, 1.5, **faulty(magnets__pole_pair=4, magnets__pole_pair_off_deg=-12.0)))
    expected = np.where(number % 36 // 6 == 3, -12.0, 0.0)
    assert np.sum(expected != 0) > 20
    np.testing.assert_allclose(off, expected, atol=0.02)


@pytest.mark.parametrize("n_p", [1, 6])
def test_an_eccentric_ring_moves_edges_by_a_sine_of_the_shafts_angle(n_p):
    run = turned(300.0, 1.0, **faulty(magnets__eccentricity_deg=8.0), **{"motor.n_p": n_p})
    number, off = places(run)
    np.testing.assert_allclose(off, 8.0 * np.sin(number * np.pi / 3 / n_p), atol=0.02)


@pytest.mark.parametrize("coupling", [{}, {"coupling.stiffness": 50.0, "coupling.backlash_deg": 0.1}])
def test_the_shaft_is_rocked_while_nothing_drives_it(coupling):
    rig = Rig(0, **faulty(shaft__rock_deg=5.0, shaft__rock_hz=20.0), **coupling)
    run = rig.run(1.0)
    t = np.arange(len(run)) / PWM_HZ
    assert np.abs(np.degrees(run["theta_true"]) - 30.0 - 5.0 * np.sin(2 * np.pi * 20.0 * t)).max() < 0.05
    assert np.all(run["tau_load_true"] == 0.0)
    rig.start()
    np.testing.assert_allclose(rig.forced(60.0, 0.0, 0.5)["omega_m"][-800:], 60.0 * RPM, atol=1e-3)
    rig.enable(False)
    rig.load(SetpointMode.TORQUE, 0.0)
    rig.load_enter_state(0)
    rig.run(3.0)  # it comes to rest, and is rocked again
    again = np.degrees(rig.run(1.0)["theta_true"])
    assert np.ptp(again) == pytest.approx(10.0, rel=0.02)


def test_a_shaft_that_trembles_about_an_edge_makes_one_sensor_toggle():
    run = Rig(0, **faulty(shaft__rock_deg=1.0, shaft__rock_hz=20.0) | {"mechanics.theta_0_deg": 60.3}).run(1.0)
    ticks, levels = edges_of(run, 1)
    assert len(ticks) == len(run.edges) == 40
    at = np.arcsin(-0.3) / (2 * np.pi * 20.0)  # 60.3 + sin is 60 there, and half a period less twice that later
    expected = np.sort(np.r_[np.arange(1, 21) / 20.0 + at, np.arange(20) / 20.0 + 0.025 - at])
    np.testing.assert_allclose(ticks / TICK_HZ, expected, atol=1e-4)
    assert list(levels[:2]) == [0, 1]


def test_the_encoder_slips_by_its_angle_at_its_moment():
    rig = Rig(0, **faulty(encoder__slip_deg=12.0, encoder__slip_at=0.25))
    rig.load(SetpointMode.SPEED, 240 * RPM)
    run = rig.run(0.5)
    off = -error_deg(run, "theta_enc")
    assert np.abs(off[:4000]).max() < 0.16
    assert np.abs(off[4000:] - 12.0).max() < 0.16
    theta = np.interp(run.edge_tick, PERIOD * np.arange(len(run)), run["theta_true"])
    counts = (run.edges["encoder"] - theta / (2 * np.pi * N_P) * COUNTS + COUNTS / 2) % COUNTS - COUNTS / 2
    slipped = run.edge_tick > 0.25 * TICK_HZ
    assert np.abs(counts[~slipped] + 0.5).max() < 1.1
    assert np.abs(counts[slipped] + 0.5 - 12.0 / 360.0 / N_P * COUNTS).max() < 1.1
    assert np.abs(places(turned(240.0, 0.5, **faulty(encoder__slip_deg=12.0)))[1]).max() < 0.02  # not the Hall edges


@pytest.mark.parametrize(("rpm", "lost"), [(600.0, 10.0), (-600.0, 10.0), (600.0, -200.0)])
def test_lost_counts_add_up_against_the_motion(rpm, lost):
    run = turned(rpm, 10.0, 2, **faulty(encoder__lost_per_rev=lost))
    gone = np.unwrap(run["theta_enc"]) - run["theta_true"]
    counts = (gone - gone[0]) / (2 * np.pi * N_P) * COUNTS
    turns = np.abs(run["theta_true"] - run["theta_true"][0]) / (2 * np.pi * N_P)
    assert turns[-1] > 99.0
    expected = -np.sign(rpm) * lost * turns
    assert np.abs(counts - expected).max() < 1.5 + 4 * np.sqrt(np.abs(expected).max())
    middle = len(counts) // 2  # a drift, not a jump
    assert counts[middle] == pytest.approx(counts[-1] / 2, abs=1.5 + 4 * np.sqrt(np.abs(expected[middle])))
    omega = run["omega_enc"][4000:].mean() / run["omega_true"][-1]
    assert omega == pytest.approx(1.0 - lost / COUNTS, abs=2e-4)


def test_an_index_pulse_puts_right_what_was_lost_in_a_turn():
    settings = {"encoder.index_resets": 1, "encoder.index_search": 1}
    run = turned(600.0, 10.0, 2, **faulty(encoder__lost_per_rev=10.0), **settings)
    turns = run["theta_true"] / (2 * np.pi * N_P)
    off = -error_deg(run, "theta_enc")[turns > 1.0] / 360.0 / N_P * COUNTS
    late = turns[turns > 1.0] % 1.0
    assert off.min() > -30.0
    assert np.abs(off[late < 0.02]).max() < 4.0
    assert off[late > 0.95].mean() == pytest.approx(-9.75, abs=4 * np.sqrt(10 / 99))


@pytest.mark.parametrize(("lines", "pulses_hat"), [(3600, 900), (3600, 7200), (4000, 4096)])
def test_lines_that_are_wrong_in_the_firmware_stretch_its_angle(lines, pulses_hat):
    settings = {"encoder.pulses_per_rev": lines}
    for more in ({}, {"encoder.index_resets": 1}):
        run = turned(300.0, 0.5, **faulty(encoder__pulses_hat=pulses_hat), **settings, **more)
        theta, turn = run["theta_true"], 2 * np.pi * N_P
        expected = (theta if not more else theta % turn) * lines / pulses_hat
        off = np.degrees((run["theta_enc"] - expected + np.pi) % (2 * np.pi) - np.pi)
        inner = (theta % turn > 0.01) & (theta > turn if more else True)
        assert np.abs(off[inner]).max() < 360.0 * N_P / (4 * pulses_hat) + 0.01
        assert run["omega_enc"][4000:].mean() == pytest.approx(
            (theta[-1] - theta[0]) / 0.5 * lines / pulses_hat, rel=2e-3
        )


def test_an_encoder_may_count_the_wrong_way():
    run = turned(300.0, 0.3, **faulty(encoder__reversed=1))
    off = np.degrees((run["theta_enc"] + run["theta_true"] + np.pi) % (2 * np.pi) - np.pi)
    assert np.abs(off).max() < 0.16
    assert run["omega_enc"][-1] == pytest.approx(-run["omega_true"][-1], abs=2.0)


EACH = {
    "hall.rise_delay": [2e-4, 0.0, 0.0], "hall.fall_delay": [0.0, 2e-4, 0.0], "hall.bounce": [0.0, 0.0, 1.0],
    "hall.pulse_rate": [0.0, 900.0, 0.0], "hall.contact_open": [0.0, 0.0, 0.3], "hall.hysteresis_deg": [0.0, 3.0, 0.0],
    "magnets.pole_pair_off_deg": 5.0, "magnets.eccentricity_deg": 5.0, "encoder.slip_deg": 5.0,
    "encoder.slip_alpha": 100.0,
    "encoder.lost_per_rev": 100.0, "encoder.pulses_hat": 3601, "encoder.reversed": 1,
}  # fmt: skip


def recorded(seconds, portions=(1.0,), **settings):
    rig = Rig(7, **settings)
    rig.load(SetpointMode.SPEED, 300 * RPM)
    runs = [rig.run(seconds * share) for share in portions]
    return [np.concatenate([run[x] for run in runs]) for x in ("theta_enc", "omega_enc")] + [
        np.concatenate([getattr(run, name) for run in runs]) for name in ("edge_tick", "edges")
    ]


@pytest.mark.parametrize("key", EACH)
def test_a_fault_is_in_force_from_begin_until_end_only(key):
    fault = {f"faults.{key}": EACH[key]}
    none = recorded(0.3)
    fit = recorded(0.3, **fault, **{"faults.begin": 0.2})
    ill = recorded(0.3, **fault, **{"faults.begin": 0.1, "faults.end": 0.2})
    assert np.array_equal(none[0][:3200], fit[0][:3200])
    before, from_there = (none[2] <= 0.1 * TICK_HZ - PERIOD), fit[2] <= 0.2 * TICK_HZ - PERIOD
    assert np.array_equal(none[2][from_there[: len(none[2])]][:5], fit[2][from_there][:5])
    assert np.array_equal(none[3][before], ill[3][: before.sum()])
    whole = recorded(0.3, **fault)
    same = [np.array_equal(a, b) for a, b in zip(none, whole, strict=True)]
    assert not all(same)
    if key != "encoder.lost_per_rev":  # what is lost stays so; all else is as if it had never been
        assert np.array_equal(none[0][4000:], ill[0][4000:])
        late = 0.21 * TICK_HZ
        assert np.array_equal(none[2][none[2] > late], ill[2][ill[2] > late])


def test_a_host_switches_faults_by_the_load_machines_parameter():
    rig = Rig(0, **faulty(encoder__slip_deg=10.0, encoder__slip_at=0.1, begin=0.2))
    offsets = []
    for faults in (None, None, None, 0.0, 1.0):  # before `begin`, ..., and by hand
        if faults is not None:
            rig.set_load_param("faults", faults)
        offsets.append(round(-error_deg(rig.run(0.1), "theta_enc")[-1] / 10.0))
    assert offsets == [0, 0, 1, 0, 1]
    assert rig.load_parameters["faults"] == 1.0


def test_the_same_bits_whatever_the_portions():
    everything = {f"faults.{key}": value for key, value in EACH.items()} | {"faults.begin": 0.05, "faults.end": 0.21}
    whole = recorded(0.25, **everything)
    parts = recorded(0.25, (0.01, 0.19, 0.004, 0.3, 0.496), **everything)
    assert [x.tobytes() for x in whole] == [x.tobytes() for x in parts]


def test_the_worst_of_all_leaves_every_edge_in_its_place_and_order():
    """Contacts of a tick, bounces within bounces, pulses back to back: each sample reads what the edges add up to."""
    rig = Rig(
        3,
        **faulty(hall__bounce=[1.0] * 3, hall__bounce_returns=20, hall__bounce_spacing=1e-6, hall__pulse_rate=[1e4] * 3,
                 hall__pulse_min=1e-6, hall__contact_open=[0.999, 0.5, 0.0], hall__contact_stretch=5e-5,
                 hall__rise_delay=[0.0, 1e-3, 0.0]),
        **{"wiring.hall_glitch": 1e5},
    )  # fmt: skip
    rig.load(SetpointMode.SPEED, 340.0)
    code = 1
    for n in [1] * 200 + [1000]:
        run = rig.advance(n)
        assert np.all(np.diff(run.edge_tick) >= 0)
        assert np.all((run.edge_tick > run.tick - PERIOD) & (run.edge_tick <= run.tick + PERIOD * (n - 1)))
        old, new = run.edges["codes"] & 7, run.edges["codes"] >> 3 & 7
        assert np.array_equal(old, np.r_[code, new[:-1]][: len(old)])
        at = np.searchsorted(run.edge_tick, run.tick + PERIOD * np.arange(n), side="right")
        assert np.array_equal(np.r_[code, new][at], run.samples["hall"])
        code = run.samples["hall"][-1]
    assert len(run.edges) > 20_000


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"magnets__pole_pair": 7, "magnets__pole_pair_off_deg": 3.0},
         r"^faults.magnets.pole_pair must be <= motor.n_p = 6, got 7"),
        ({"magnets__pole_pair_off_deg": 40.0, "hall__hysteresis_deg": [0.0, 20.0, 0.0]},
         r"sector 1 only 60 deg wide.*with 60 deg by \[faults\], = 60 deg"),
        ({"begin": 2.0, "end": 1.0}, r"^end must be > begin = 2 s, or 0 for never, got 1 \(faults in overrides\)"),
        ({"hall__pulse_min": 2e-4}, r"^pulse_min must be <= pulse_max = 0.0001 s, got 0.0002"),
        ({"hall__pulse_rate": [0.0, 2e3, 0.0], "hall__pulse_max": 1e-2},
         r"^pulse_rate must be <= 180 1/s for pulses of 0.00501 s, got 2000"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_in_a_line(settings, words):
    with pytest.raises(ConfigError, match=words):
        load_params(None, faulty(**settings))


def test_edges_are_not_moved_where_a_fault_to_come_would_leave_no_room():
    rig = Rig(0, **faulty(begin=0.01, magnets__pole_pair_off_deg=40.0))
    with pytest.raises(ConfigError, match=r"sector 1 only 35 deg wide"):
        rig.set_load_param("hall_delta_1", np.radians(-25.0))
    rig.run(0.02)
    assert rig.load_parameters["faults"] == 1.0


def test_by_default_no_fault_is_in_the_configuration():
    faults = load_params().faults
    assert faults == faults.without()
