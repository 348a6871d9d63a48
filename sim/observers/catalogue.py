"""The observers by name, each with what it takes to run it on the front end's samples.

Another observer is another line of `_ENTRIES`. Nothing here runs one, and no parameter is checked against a range.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.observers import (
    average_speed,
    hall_vector,
    hall_vector_decoupled,
    learned_edges,
    load_angle,
    lookup_table,
    programmable_filter,
    vector_tracking,
    vector_tracking_q15,
    zeroth_order,
)
from sim.observers.sample import Samples
from sim.observers.zeroth_order import Settings as NoSettings

DEFAULTS: Mapping[str, float] = {
    "hall_timeout": 0.2,  # s
    "k_p_vt": 1268.0,  # 1/s, Fig. 6 of Kim et al. 2011
    "k_i_vt": 54289.0,  # 1/s²
    "tau_max": 0.5e-3,  # s
    "omega_on": 20.0,  # electrical rad/s
    "omega_off": 12.0,
    "bw_omega_lpf": 50.0,  # Hz
    "load_angle_comp": 0.0,
    "k_pc": 0.0,  # rad/A
    "k_ic": 11.0,  # rad/(A s)
    "literal_sgn": 0.0,
    "bw_hall_vector": 10.0,  # Hz
    "learn_edges": 1.0,
}
"""What a parameter is where a drive has none of that name: the values of the simulated drive. Motor data have none."""


@dataclass(frozen=True)
class Entry:
    """One observer. `short`: its name in channels, as `theta_<short>`; `source`: where it comes from, in one line."""

    name: str
    short: str
    source: str
    init: Callable[[], Any]
    run: Callable[..., tuple[Any, Any]]
    """`run(params, state, samples, reset)`: the next state, and estimates with `theta` and `omega`, (n,) each."""
    make: Callable[[float, Any], Any]
    """`make(pwm_hz, settings)`: its constants."""
    settings: type[Any]
    """A dataclass: its fields are the drive parameters that it takes, by their names."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the drive parameters that it depends on."""
        return names(self.settings)

    def missing(self, drive: Mapping[str, float]) -> tuple[str, ...]:
        """Parameters that it cannot do without and that are neither in a drive's table nor in `DEFAULTS`."""
        return missing(self.settings, drive)

    def make_params(self, pwm_hz: float, drive: Mapping[str, float]) -> Any:
        """Its constants from a drive's whole parameter table, rounded to float32 as a drive stores them.

        What it does not need is ignored; what is not there comes from `DEFAULTS`. Nothing may be `missing`.
        """
        return self.make(pwm_hz, chosen(self.settings, drive))


def names(settings: type[Any]) -> tuple[str, ...]:
    """The drive parameters that settings are made of."""
    return tuple(field.name for field in fields(settings))


def missing(settings: type[Any], drive: Mapping[str, float]) -> tuple[str, ...]:
    """What settings cannot do without and is neither in a drive's table nor in `DEFAULTS`."""
    needed = (field.name for field in fields(settings) if field.default is MISSING)
    return tuple(name for name in needed if name not in drive and name not in DEFAULTS)


def chosen(settings: type[Any], drive: Mapping[str, float]) -> Any:
    """Settings from a drive's table, what is not there from `DEFAULTS`; rounded to float32."""
    table = {**DEFAULTS, **drive}
    return settings(**{name: float(np.float32(table[name])) for name in names(settings) if name in table})


def _of(module: ModuleType, short: str, source: str) -> Entry:
    name = module.__name__.rpartition(".")[2]
    return Entry(name, short, source, module.init, module.run, module.make_params, module.Settings)


def _nothing(*_: object) -> None:
    """What the average-speed approach remembers and is told: the front end has done it all."""


def _by_the_front_end(
    params: None, state: None, samples: Samples, reset: NDArray[np.bool_]
) -> tuple[None, average_speed.Estimates]:
    return None, average_speed.Estimates(samples.theta_avg, samples.hall.omega)


_KIM = "Kim et al. 2011, DOI 10.1109/TIE.2010.2098367"
_ENTRIES = (
    Entry("average_speed", "avg", f"(1)-(2) of {_KIM}; [13]", _nothing, _by_the_front_end, _nothing, NoSettings),
    _of(vector_tracking, "vt", f"(3)-(10) of {_KIM}"),
    _of(load_angle, "la", f"(3)-(10) with (18)-(19) of {_KIM}"),
    _of(zeroth_order, "zero", "[14]: Morimoto et al. 2003"),
    _of(lookup_table, "lut", "[15]: Beccue et al. 2007"),
    _of(hall_vector, "hv", "[16]: Giulii Capponi et al. 2006"),
    _of(hall_vector_decoupled, "hvd", "[17]: Harke et al. 2008"),
    _of(programmable_filter, "plf", "[18]: Karanayil et al. 2004"),
    _of(vector_tracking_q15, "q15", f"(3)-(10) of {_KIM}, in 16-bit integers"),
    _of(learned_edges, "le", "docs/learned-edges.md"),
)

CATALOGUE: dict[str, Entry] = {entry.name: entry for entry in _ENTRIES}
"""By name, in the order of `protocol.signals.AngleSource`, which begins with the encoder."""
