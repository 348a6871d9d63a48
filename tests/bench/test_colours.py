"""Lines that are shown together can be told apart, by colour-blind eyes too.

Distances are Euclidean in CAM02-UCS, where 1 is about what can just be seen of two fields side by side. What eyes
without one kind of cones see is simulated with the matrices of Machado, Oliveira and Fernandes 2009 (DOI
10.1109/TVCG.2009.113) at severity 1.0, on linear RGB. Contrasts are those of WCAG 2.

Which lines are shown together is asked of the dashboard and of the figures, so that a new plot is tested, too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from itertools import combinations

import numpy as np
import pytest
from colorspacious import cspace_convert
from colorspacious.cvd import machado_et_al_2009_matrix

from bench.record.info import RunInfo
from bench.replay.augment import host_channels
from bench.report.style import SERIES
from bench.score.plots import draw_error_by_speed
from bench.signal.colours import GROUND, OBSERVERS, RGB, SPARES, TABLE, apart, look, rgb
from bench.view import states
from bench.view.plane import Plane
from bench.view.plots import plots
from bench.view.schema import VECTORS
from protocol.signals import DRIVE_CHANNELS, Flag
from sim.observers.catalogue import CATALOGUE

EYES = ("normal", "protanomaly", "deuteranomaly", "tritanomaly")  # the last three at their severest: -opia
LEAST = dict(zip(EYES, (15.0, 10.0, 10.0, 10.0), strict=True))
LEAST_USUAL = dict(zip(EYES, (19.0, 12.5, 12.5, 12.5), strict=True))  # of what a drive streams if nobody asks for more
LEAST_PAPER = dict(zip(EYES, (17.0, 12.0, 12.0, 12.0), strict=True))
LEAST_SPARE = dict(zip(EYES, (9.0, 6.0, 6.0, 6.0), strict=True))  # where one of two has a spare colour
LEAST_CONTRAST_DARK, LEAST_CONTRAST_PAPER = 4.5, 3.0
MOST_HUE = 28.0  # degrees between the two grounds
PAPER = (255, 255, 255)
SPARE = {colour for spare in SPARES for colour in (spare.rgb, rgb(spare.paper))}

USUAL = tuple(channel for channel in DRIVE_CHANNELS if not channel.flags & Flag.ON_REQUEST)
SHORTS = [observer.short for observer in CATALOGUE.values()]
RUNS = {
    "usual": USUAL,
    "all that there is": DRIVE_CHANNELS,
    "replayed by the host": (*USUAL, *host_channels(SHORTS, USUAL)),
    "observers of others": (*DRIVE_CHANNELS, *host_channels(["mine", "yours", "theirs"], DRIVE_CHANNELS)),
    "all twice": (*DRIVE_CHANNELS, *host_channels(SHORTS, DRIVE_CHANNELS)),
}


def run_of(name: str) -> RunInfo:
    return RunInfo(20_000_000, 16_000, RUNS[name], {"n_p": 6.0})


def linear(colours: Iterable[RGB]) -> np.ndarray:
    return cspace_convert(np.array(list(colours)) / 255, "sRGB1", "sRGB1-linear")


def seen(colours: Iterable[RGB], eyes: str) -> np.ndarray:
    """Coordinates in CAM02-UCS, (n, 3)."""
    light = linear(colours)
    if eyes != "normal":
        light = np.clip(light @ machado_et_al_2009_matrix(eyes, 100).T, 0, 1)
    return cspace_convert(light, "sRGB1-linear", "CAM02-UCS")


def luminance(colour: RGB) -> float:
    return float(linear([colour])[0] @ (0.2126, 0.7152, 0.0722))


def contrast(one: RGB, other: RGB) -> float:
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def too_near(
    shown: Mapping[str, RGB], least: Mapping[str, float] = LEAST, spare: Mapping[str, float] = LEAST_SPARE
) -> list[str]:
    """Pairs that are nearer to each other than they may be, with their distance."""
    found = []
    for eyes in EYES:
        places = dict(zip(shown, seen(shown.values(), eyes), strict=True))
        for one, other in combinations(shown, 2):
            distance = float(np.linalg.norm(places[one] - places[other]))
            bound = (spare if {shown[one], shown[other]} & SPARE else least)[eyes]
            if distance < bound:
                found.append(f"{one}, {other}, {eyes}: {distance:.1f}")
    return found


def arrows(run: RunInfo) -> dict[str, RGB]:
    """What the stator plane shows."""
    packed = dict(Plane(run).frame())[VECTORS].colors.as_arrow_array().to_pylist()
    return {f"arrow {k}": (c >> 24, c >> 16 & 255, c >> 8 & 255) for k, c in enumerate(packed)}


@pytest.mark.parametrize("name", RUNS)
def test_lines_of_a_plot_and_arrows_of_the_plane_differ(name: str) -> None:
    run = run_of(name)
    least = LEAST_USUAL if name == "usual" else LEAST
    for plot in plots(run).values():
        shown = {line.name: line.colour for line in plot.lines}
        assert len(set(shown.values())) == len(shown) == len(plot.lines), plot.name
        assert too_near(shown, least) == [], plot.name
    assert too_near(arrows(run), least) == []


@pytest.mark.parametrize("name", ["usual", "all that there is"])
def test_the_same_lines_differ_on_paper(name: str) -> None:
    for plot in plots(run_of(name)).values():
        shown = {line.name: rgb(look(line.channel).paper) for line in plot.lines if not line.derived}
        assert too_near(shown, LEAST_PAPER) == [], plot.name


def test_observers_differ_from_what_they_are_compared_with_and_on_paper_by_their_marks() -> None:
    assert too_near({short: one.rgb for short, one in OBSERVERS.items()}) == []
    assert too_near({short: rgb(one.paper) for short, one in OBSERVERS.items()}, LEAST_PAPER) == []
    drawn = [*apart({short: f"theta_{short}" for short in SHORTS}).values()]
    marks = Counter(one.mark for one in {*drawn, *SPARES})
    assert [mark for mark, n in marks.items() if n > 1] == []


def test_every_look_stands_out_from_its_grounds_and_has_one_hue_on_both() -> None:
    looks = set(TABLE.values()) | set(SPARES)
    assert len({one.dark for one in looks}) == len({one.paper for one in looks}) == len(looks)
    for one in looks:
        assert contrast(one.rgb, GROUND) >= LEAST_CONTRAST_DARK
        assert contrast(rgb(one.paper), PAPER) >= LEAST_CONTRAST_PAPER
        (_, *dark), (_, *paper) = seen([one.rgb, rgb(one.paper)], "normal")
        grey = np.hypot(*dark) < 4 and np.hypot(*paper) < 4
        turn = np.degrees(np.arctan2(dark[1], dark[0]) - np.arctan2(paper[1], paper[0]))
        assert grey or abs((turn + 180) % 360 - 180) <= MOST_HUE, one


def test_observers_on_the_score_board_differ() -> None:
    names = [*CATALOGUE, "drive_vt", "drive_avg", "replayed_vt", "drive_mine"]
    figures = {"by_speed": {bin: {"std": 1.0, "max": 2.0} for bin in ("0_to_150", "150_to_350")}}
    lines = draw_error_by_speed(dict.fromkeys(names, figures)).axes[0].lines
    shown = {str(line.get_label()): rgb(str(line.get_color())) for line in lines}
    assert (list(shown), too_near(shown, LEAST_PAPER)) == (names, [])
    assert shown["vector_tracking"] == rgb(OBSERVERS["vt"].paper)


def test_the_hosts_estimate_has_its_observers_colour_where_the_drives_own_is_not_shown() -> None:
    colours = run_of("replayed by the host").colours
    assert colours["theta_ek_host"] == colours["omega_ek_host"] == OBSERVERS["ek"].rgb
    assert colours["theta_vt"] == OBSERVERS["vt"].rgb
    assert colours["theta_vt_host"] == colours["omega_vt_host"] == SPARES[1].rgb
    others = run_of("observers of others").colours
    assert others["theta_mine_host"] == others["omega_mine_host"] == SPARES[0].rgb


def test_what_stands_in_one_lane_differs() -> None:
    """Words of one meaning may share a colour: all faults, and what is quiet."""
    marks = {verdict.name: colour for verdict, colour in states.VERDICT_COLOURS.items()}
    hall = {word: states.HALL_COLOURS[word] for word in (states.LOW, states.HIGH, states.ILLEGAL)}
    for lane in (*states.DRIVE_LANES.values(), marks, hall):
        words = {colour: word for word, colour in lane.items()}
        assert too_near({word: colour for colour, word in words.items()}) == []


def test_series_of_up_to_four_differ_on_paper() -> None:
    assert too_near({colour: rgb(colour) for colour in SERIES[:4]}, spare=LEAST_PAPER) == []


def test_no_colour_stands_for_two_things_on_the_first_page() -> None:
    """Normal eyes tell apart whatever a usual drive shows there, not only what stands in one plot."""
    run = run_of("usual")
    shown = {
        line.channel.replace("omega_", "theta_"): line.colour
        for key in ("error_trend", "speed", "dq", "position", "phases")
        for line in plots(run)[key].lines
    }
    del shown["i_q_ref"]  # a reference, as that of the speed
    shown |= {"voltage": TABLE["u_alpha"].rgb, "back-EMF": TABLE["e_alpha"].rgb}
    places = dict(zip(shown, seen(shown.values(), "normal"), strict=True))
    near = {
        f"{one}, {other}": round(float(np.linalg.norm(places[one] - places[other])), 1)
        for one, other in combinations(shown, 2)
    }
    assert {pair: distance for pair, distance in near.items() if distance < LEAST["normal"]} == {}
