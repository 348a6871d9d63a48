"""The observers by name: those of this package, and those that others have installed.

Another observer is another line of `_ENTRIES`; or, from another package, an entry point of the group
`hallbench.observers` that names an `Entry`. Nothing here runs one, and no parameter is checked against a range.
"""

from __future__ import annotations

from importlib.metadata import entry_points

from sim.observers import (
    by_front_end,
    edge_kalman,
    hall_vector,
    hall_vector_decoupled,
    load_angle,
    lookup_table,
    programmable_filter,
    sector_centre,
    vector_tracking,
    vector_tracking_q15,
)
from sim.observers.entry import CURRENT, EDGES_ALONE, VOLTAGE, WITH_VOLTAGE, Entry, Needs

GROUP = "hallbench.observers"

_KIM = "Kim et al. 2011, DOI 10.1109/TIE.2010.2098367"
_VT = {"delta_hat": "delta_hat", "e_alpha": "e_alpha", "e_beta": "e_beta"}
_EK = {"sensors_ek": "sensors", "sigma_ek": "sigma"}
_EK |= {"lesson_ek": "lesson", "lesson_value_ek": "learned", "lesson_sigma_ek": "learned_sd"}
_TORQUE = Needs(helpful=CURRENT, without={"psi_f_hat": 0.0, "J_hat": 0.0})
_EMF = Needs(helpful=(*VOLTAGE, *CURRENT), without={"R_s_hat": 0.0, "L_s_hat": 0.0, "psi_f_hat": 1.0})
_ENTRIES = (
    Entry.of(by_front_end, "avg", f"(1)-(2) of {_KIM}; [13], [14]", "average_speed", EDGES_ALONE),
    Entry.of(vector_tracking, "vt", f"(3)-(10) of {_KIM}", needs=WITH_VOLTAGE, **_VT),
    Entry.of(load_angle, "la", f"(3)-(10) with (18)-(19) of {_KIM}"),
    Entry.of(sector_centre, "sc", "six-step drives", needs=EDGES_ALONE),
    Entry.of(lookup_table, "lut", "[15]: Beccue et al. 2007", needs=EDGES_ALONE),
    Entry.of(hall_vector, "hv", "[16]: Giulii Capponi et al. 2006", needs=_TORQUE),
    Entry.of(hall_vector_decoupled, "hvd", "[17]: Harke et al. 2008", needs=_TORQUE),
    Entry.of(programmable_filter, "plf", "[18]: Karanayil et al. 2004"),
    Entry.of(vector_tracking_q15, "q15", f"(3)-(10) of {_KIM}, in 16-bit integers"),
    Entry.of(edge_kalman, "ek", "docs/edge-kalman.md", needs=_EMF, **_EK),
)

CATALOGUE: dict[str, Entry] = {entry.name: entry for entry in _ENTRIES}
"""By name, in the order of `protocol.signals.AngleSource`, which begins with the encoder; then the others' by name."""
BROKEN: dict[str, str] = {}
"""Why an observer that others have installed cannot be used, by the name of its entry point."""


def _add_others() -> None:
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        try:
            entry = point.load()
            if not isinstance(entry, Entry):
                raise TypeError(f"{point.value} is no Entry")
            taken = {word for known in CATALOGUE.values() for word in (known.name, known.short)}
            if double := sorted(taken & {entry.name, entry.short}):
                raise ValueError(f"there is an observer {double[0]} already")
        except Exception as error:  # whatever another's code raises
            BROKEN[point.name] = f"{type(error).__name__}: {error}"
        else:
            CATALOGUE[entry.name] = entry


_add_others()
