"""What a check concludes from captures made by formula: causes that the simulated drive cannot have, and doubt."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hall_motor import REAL, TABLE_I, Motor, capture

from bench.findings.health import Health, examine
from bench.hall.report import WIDTH, as_json, edge_rows, fact_rows, tables, verdict_lines
from bench.hall.trace import trace
from bench.signal.verdict import Verdict

OFF = REAL.but(running=False)


def check(motor: Motor) -> Health:
    return examine(trace(capture(motor)))


def causes(health: Health) -> list[str]:
    return [f"{finding.code}: {finding.cause}" for finding in health.findings]


def test_the_papers_sensors_are_healthy_with_and_without_back_emf():
    for motor in (REAL, OFF):
        found = check(motor)
        assert found.verdict is Verdict.PASS
        assert found.findings == found.missing == ()
        assert (found.wiring.share, found.emf is None) == (1.0, motor is OFF)


def test_a_reversed_encoder_is_told_from_exchanged_wires_by_the_back_emf():
    backwards = {"encoder": lambda theta: math.radians(10.0) - theta}
    by_emf = check(REAL.but(**backwards))
    assert causes(by_emf) == ["encoder_reversed: the encoder counts in the wrong direction"]
    assert "their sum is 10.0 deg" in by_emf.findings[0].evidence[0]
    [without] = check(OFF.but(**backwards)).findings
    two = "two Hall wires are exchanged and the ring rotated"
    assert without.cause == f"the encoder counts in the wrong direction, or {two}"


@pytest.mark.parametrize(
    "turned_deg", [30.0, *(pytest.param(each, marks=pytest.mark.slow) for each in (20.0, 91.0, -60.0, 180.0))]
)
def test_a_ring_that_is_turned_is_found_and_no_fault_where_the_drive_does_not_say_where_it_stands(turned_deg):
    turned = REAL.but(delta_deg=tuple(delta - turned_deg for delta in TABLE_I))
    stands = turned_deg - float(np.mean(TABLE_I))
    for motor in (turned, turned.but(running=False)):
        found = check(motor)
        assert (found.verdict, found.findings) == (Verdict.PASS, ())
        assert math.degrees(found.measured.ring - math.radians(stands)) % 360.0 == pytest.approx(0.0, abs=0.5) or (
            math.degrees(found.measured.ring - math.radians(stands)) % 360.0 == pytest.approx(360.0, abs=0.5)
        )
        assert [note.code for note in found.notes] == ["ring"]
        told = motor.but(parameters={"hall_offset": math.radians((stands + 180.0) % 360.0 - 180.0)})
        assert check(told).verdict is Verdict.PASS
        [wrong] = check(motor.but(parameters={"hall_offset": 0.0})).findings
        assert wrong.code == ("wiring" if turned_deg == 180.0 else "hall_setting")
    assert check(turned).measured.edges[0].offset == pytest.approx(check(turned).measured.ring)


def test_a_ring_is_told_from_the_encoders_zero_by_the_back_emf():
    [zero] = check(REAL.but(encoder=lambda theta: theta + math.radians(20.0))).findings
    assert zero.code == "encoder_zero"
    assert zero.cause.startswith("the encoder's zero is 20.")
    told = {"parameters": {"hall_offset": 0.0}, "running": False}
    [either] = check(REAL.but(encoder=lambda theta: theta + math.radians(20.0), **told)).findings
    assert either.code == "hall_setting"
    assert either.evidence == ("an encoder whose zero is off by as much looks the same; the back-EMF would tell",)


@pytest.mark.parametrize("zero_deg", [0.0, 1.0, -2.0, 5.0, 7.0, -7.0, 40.0, -110.0, 179.0])
def test_a_zero_of_the_encoder_beyond_its_uncertainty_is_a_finding_and_no_more_than_one(zero_deg):
    found = check(REAL.but(encoder=lambda theta: theta + math.radians(zero_deg)))
    assert math.degrees(found.emf.zero) == pytest.approx(zero_deg, abs=0.3)
    assert math.degrees(found.emf.spread) < 0.2
    assert found.emf.clear > 0.99
    if abs(zero_deg) < 2.5:
        assert found.verdict is Verdict.PASS
        return
    [finding] = found.findings
    assert finding.code == "encoder_zero"
    assert (found.wiring.best, found.wiring.share) == ("as specified", 1.0)


@pytest.mark.parametrize("zero_deg", [0.0, 6.0])
@pytest.mark.parametrize("moved", [3.0, 14.0, -19.0])
def test_a_displaced_sensor_is_named_with_its_edges_and_angle_whatever_the_encoders_zero(moved, zero_deg):
    delta = [value - (moved if sector in (1, 4) else 0.0) for sector, value in enumerate(TABLE_I)]  # b rises and falls
    found = check(REAL.but(delta_deg=delta, encoder=lambda theta: theta + math.radians(zero_deg)))
    told = [finding for finding in found.findings if finding.code != "encoder_zero"]
    assert len(found.findings) - len(told) == (zero_deg != 0.0)
    if moved == 3.0:
        assert told == []
        return
    stood = [-(TABLE_I[k] + TABLE_I[k + 3]) / 2.0 for k in range(3)]  # c, b, a
    expected = moved + stood[1] - (stood[0] + stood[2]) / 2.0
    assert [(finding.code, finding.cause) for finding in told] == [
        ("displaced", f"sensor b is displaced by {expected:.1f} deg against the other two (edges II and V)")
    ]


def test_a_back_emf_that_turns_with_the_direction_makes_the_zero_less_certain():
    wrong = {"parameters": {"L_s_hat": 1.5e-3, "hall_offset": 0.0}, "current": lambda t: np.where(t < 3.5, 2.0, -2.0)}
    for zero_deg, verdict in ((0.0, Verdict.PASS), (5.0, Verdict.PASS), (40.0, Verdict.FAIL)):
        found = check(REAL.but(encoder=lambda theta, by=zero_deg: theta + math.radians(by), **wrong))
        assert math.degrees(found.emf.spread) > 4.0
        assert found.verdict is verdict


def test_a_rotation_without_back_emf_names_what_else_it_may_be():
    rotated = {"rewire": lambda abc: (abc[2], abc[0], abc[1]), "parameters": {"hall_offset": 0.0}}
    [certain], [doubtful] = check(REAL.but(**rotated)).findings, check(OFF.but(**rotated)).findings
    assert certain.cause == doubtful.cause == "sensors rotated (a on b, b on c, c on a)"
    assert len(certain.evidence) == 1
    assert "an encoder whose zero is off by as much looks the same" in doubtful.evidence[1]


def test_an_uneven_duty_and_unsteady_edges_are_faults_of_their_own():
    [uneven] = check(REAL.but(delta_deg=(0.0, 10.0, 0.0, 0.0, -10.0, 0.0))).findings
    assert (uneven.code, uneven.cause) == ("duty", "sensor b is 1 over 55.6 % of a revolution")
    [unsteady] = check(REAL.but(jitter_deg=3.0)).findings
    assert unsteady.code == "unsteady"
    assert check(REAL.but(jitter_deg=1.0)).verdict is Verdict.PASS


@pytest.mark.parametrize(("in_drive", "of_motor"), [(1, 6), (3, 6), (5, 6), (7, 6), (12, 6), (18, 6), (2, 14)])
def test_any_other_number_of_pole_pairs_is_told_with_the_right_one(in_drive, of_motor):
    found = check(REAL.but(n_p=in_drive, encoder=lambda theta: theta * in_drive / of_motor))
    [finding] = found.findings
    assert finding.code == "pole_pairs"
    assert finding.cause.startswith(f"wrong number of pole pairs: {in_drive} in the drive, {of_motor} would fit; or ")
    electrical = (60.0 * 2.0 + 120.0 * 1.5) / (2 * math.pi) * in_drive / of_motor
    assert (found.turns.up, found.turns.down) == pytest.approx((electrical, electrical), rel=0.02)


def test_an_encoder_that_slips_has_no_pole_pairs():
    [finding] = check(REAL.but(encoder=lambda theta: theta * 0.917)).findings
    assert finding.code == "encoder_slips"
    assert "6 x 1.09" in finding.evidence[1]


def test_pulses_of_less_than_a_millisecond_are_pulses_at_a_speed_at_which_a_sector_takes_17():
    breaks = Motor(
        turns=((60.0, 2.0), (0.0, 0.05), (-60.0, 2.0)),
        pulses=[(0.31 + 0.25 * k + late, 1) for k in range(14) for late in (0.0, 0.0007)],
    )
    made = capture(breaks)
    long = made.edges.tick[np.flatnonzero(np.diff(made.edges.tick) == 60)]
    assert len(long) == 28  # pairs of pulses: now their middle edges go, and a break of 0.7 ms is left
    keep = np.ones(len(made.edges), bool)
    starts = np.flatnonzero(np.diff(made.edges.tick) == 60)
    keep[starts[0::2] + 1] = False
    keep[starts[1::2]] = False
    columns = ("tick", "hall_old", "hall_new", "illegal", "encoder", "index")
    edges = replace(made.edges, **{name: getattr(made.edges, name)[keep] for name in columns})
    codes = [finding.code for finding in examine(trace(replace(made, edges=edges))).findings]
    assert codes == ["pulses"]


def test_without_an_encoder_only_some_faults_show():
    blind = REAL.but(without=("theta_enc", "omega_enc"))
    healthy = check(blind)
    assert healthy.verdict is Verdict.INVALID
    assert "no encoder was recorded" in healthy.missing[0]
    for number, name in enumerate("abc"):

        def inverted(abc: tuple[int, int, int], number: int = number) -> tuple[int, int, int]:
            return tuple(level ^ (k == number) for k, level in enumerate(abc))  # type: ignore[return-value]

        apart = f"or sensors 60 deg apart, {name} in the middle"
        assert causes(check(blind.but(rewire=inverted))) == [f"wiring: sensor {name} inverted, {apart}"]
    assert causes(check(blind.but(rewire=lambda abc: (abc[0], 0, abc[2])))) == ["dead: sensor b shorted (always 0)"]


def test_little_data_is_not_health():
    for turns, words in (
        (((60.0, 0.02),), "only 0.2 electrical revolutions"),
        (((60.0, 2.0),), "19.1 electrical revolutions forward and 0.0 reverse; at least"),
        (((60.0, 0.3), (0.0, 0.05), (-60.0, 0.3)), "an edge was passed"),
    ):
        found = check(REAL.but(turns=turns))
        assert found.verdict is Verdict.INVALID
        assert words in found.missing[0]
    assert check(REAL.but(turns=((60.0, 2.0),), rewire=lambda abc: (abc[1], abc[0], abc[2]))).verdict is Verdict.FAIL


def test_two_false_pulses_are_none_and_many_are_a_fault():
    few = check(REAL.but(pulses=[(0.5, 0), (1.5, 1)]))
    assert (few.verdict, few.pulses.n) == (Verdict.PASS, 2)
    [finding] = check(REAL.but(pulses=[(0.1 + 0.2 * k, 2) for k in range(30)])).findings
    assert finding.code == "pulses"
    assert finding.evidence[0].startswith("30 pulses of at most 3.0 us, 4.")
    assert finding.evidence[0].endswith("a 0, b 0, c 30")


def test_a_report_fits_a_terminal_and_its_json_says_the_same():
    from bench.hall.turning import Turned

    for motor in (
        REAL,
        REAL.but(rewire=lambda abc: (abc[1], abc[0], abc[2]), pulses=[(0.1 + 0.2 * k, 2) for k in range(30)]),
    ):
        made = capture(motor)
        looked_at = trace(made)
        health, turned = examine(looked_at), Turned(made, "by hand", ("a remark",))
        rows = edge_rows(health)
        assert max(map(len, verdict_lines(health, turned.remarks))) <= WIDTH
        shown = tables(health, looked_at.seconds)
        for title, headers, cells in shown:
            assert max(map(len, title), default=0) <= WIDTH
            widths = [max(map(len, column)) for column in zip(headers, *cells, strict=True)]
            assert sum(widths) + 3 * len(widths) <= WIDTH  # rich takes 3
        assert all(len(row) == 2 for row in fact_rows(health, looked_at, turned))
        data = as_json(health, looked_at, turned, "x")
        assert data["exit_code"] == health.exit_code
        assert [f["cause"] for f in data["findings"]] == [f.cause for f in health.findings]
        for row, edge in zip(rows, data["edges"], strict=True):
            assert float(row[1]) == pytest.approx(edge["up"]["angle_deg"], abs=0.0051)
            assert row[4] == f"{edge['up']['n']}/{edge['down']['n']}"
    assert "Sectors' widths in electrical degrees" not in [title[0] for title, *_ in shown if title]  # wires exchanged
