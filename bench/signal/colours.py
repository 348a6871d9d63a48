"""Which colour stands for what: one table, for the dashboard's dark ground and for white paper.

A quantity has one hue on both. Lines that are shown together can be told apart, by colour-blind eyes too: where hues do
not suffice for that, one of two is light and the other dark. How far apart they are is computed in
tests/bench/test_colours.py; the colours were found by a search for the largest of the smallest distances there, with
white, grey, orange, blue and yellow given. On paper marks and dashes tell observers apart as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import cycle
from typing import NamedTuple

RGB = tuple[int, int, int]


class Look(NamedTuple):
    """Colours on the dark ground and on paper; on paper also the mark of a point and the dash of a line of points."""

    dark: str
    paper: str
    mark: str = "o"
    dash: str = "-"

    @property
    def rgb(self) -> RGB:
        """The colour on the dark ground, as numbers."""
        return rgb(self.dark)


def rgb(colour: str) -> RGB:
    """Red, green and blue of #rrggbb."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


GROUND = rgb("#0e1011")  # that the dark colours are made for

OBSERVERS = {
    "enc": Look("#f0f0f0", "#181818"),
    "true": Look("#888078", "#909090"),
    "avg": Look("#f88818", "#e07808", "o"),  # orange
    "vt": Look("#88a8ff", "#0050f0", "s"),  # blue
    "la": Look("#8870ff", "#9080f8", "v", "--"),  # violet
    "sc": Look("#f02848", "#781800", "P"),  # red
    "lut": Look("#d0b070", "#987848", "^"),  # tan
    "hv": Look("#c840c8", "#682058", "<"),  # purple
    "hvd": Look("#f898c8", "#b03870", ">", "--"),  # pink
    "plf": Look("#188890", "#30a0b8", "X"),  # teal
    "q15": Look("#c8c0ff", "#4828a8", "x", ":"),  # lavender, indigo
    "ek": Look("#98d8b0", "#185038", "D"),  # green
}
"""By the short name in their channels, `theta_vt` and `omega_vt`; with the encoder and the simulated plant's truth."""
_REFERENCE = Look("#f0e008", "#586800")  # yellow
TABLE = {f"theta_{short}": look for short, look in OBSERVERS.items()} | {
    "omega_ref": _REFERENCE,
    "i_q_ref": _REFERENCE,
    "i_d_ref": Look("#708848", "#989858"),
    "i_d": Look("#60e0e0", "#087870"),
    "i_q": Look("#c080c0", "#d048d0"),  # and the current as a vector
    "i_a": Look("#c0f0b0", "#305818"),
    "i_b": Look("#c89070", "#c88048"),
    "i_c": Look("#88a0a8", "#2888c0"),
    "u_alpha": Look("#d84090", "#881880"),  # and the voltage as a vector
    "u_beta": Look("#d090c8", "#c06898"),
    "u_dc": Look("#0880d8", "#0828d8"),
    "e_alpha": Look("#60ff68", "#384818"),  # and the back-EMF as a vector
    "e_beta": Look("#98b040", "#608010"),
}
"""By the channel; a speed has the look of its angle (see `quantity`)."""
SPARES = (
    Look("#c8ffb0", "#70a048", "*"),
    Look("#ff70f0", "#9050a8", "d"),
    Look("#38b8a0", "#008888", "p"),
    Look("#d07868", "#a00040", "h"),
    Look("#a070b0", "#9070b8", "8"),
    Look("#a8f8ff", "#006868", "H"),
    Look("#60d840", "#588868", "+"),
    Look("#c8d890", "#706830", "1"),
    Look("#70a080", "#00a800", "2"),
    Look("#c8d8ff", "#4870ff", "3"),
)
"""For all that is not in the table, observers of others among it; the first four are far from each other."""

GOOD, WARNING, BAD, FAULTY = (72, 168, 128), (224, 168, 32), (224, 40, 40), (152, 72, 168)
QUIET, OFF = (104, 104, 104), (40, 40, 40)
"""Of states and verdicts, as grounds of words."""


def quantity(channel: str) -> str:
    """What a channel's colour stands for, by its name in the table: the speed of an observer has that of its angle."""
    speed = channel.startswith("omega_") and channel not in TABLE
    return channel.replace("omega_", "theta_", 1) if speed else channel


def look(channel: str) -> Look:
    """The look of a channel by itself: a spare one, always the same, where it is not in the table."""
    name = quantity(channel)
    return TABLE.get(name) or SPARES[sum(name.encode()) % len(SPARES)]


def apart(wanted: Mapping[str, str]) -> dict[str, Look]:
    """Looks of things that may be shown together, by the names in the table that they want: no two are the same.

    The first that wants a look has it, all others have spare ones in their order; an eleventh has that of the first.
    """
    free, spare = dict(TABLE), cycle(SPARES)
    return {thing: free.pop(name) if name in free else next(spare) for thing, name in wanted.items()}
