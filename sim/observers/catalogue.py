"""The observers by name, each with what it takes to run it on the front end's samples.

Another observer is another line of `_ENTRIES`. Nothing here runs one, and no parameter is checked against a range.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
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

EDGES = tuple(f"edge_{way}_{s}" for way in ("up", "down") for s in range(1, 7))
"""Where the Hall edges lie, ideal less actual angle, rad: what `**edges` of a `make_params` stands for."""


@dataclass(frozen=True)
class Entry:
    """One observer. `short`: its name in channels, as `theta_<short>`; `source`: where it comes from, in one line."""

    name: str
    short: str
    source: str
    init: Callable[[], Any]
    run: Callable[..., tuple[Any, Any]]
    """`run(params, state, samples, reset)`: the next state, and estimates with `theta` and `omega`, (n,) each."""
    make: Callable[..., Any]
    signature: Callable[..., Any]
    """Whose keyword arguments are the drive parameters that `make` takes."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the drive parameters that it depends on."""
        return tuple(keyword_parameters(self.signature))

    def missing(self, drive: Mapping[str, float]) -> tuple[str, ...]:
        """Parameters that it cannot do without and that are neither in a drive's table nor in `DEFAULTS`."""
        return missing(self.signature, drive)

    def make_params(self, pwm_hz: float, drive: Mapping[str, float]) -> Any:
        """Its constants from a drive's whole parameter table, rounded to float32 as a drive stores them.

        What it does not need is ignored; what is not there comes from `DEFAULTS`. Nothing may be `missing`.
        """
        return self.make(pwm_hz, **chosen(self.signature, drive))


def keyword_parameters(function: Callable[..., Any]) -> dict[str, bool]:
    """The numbers that a `make_params` takes by name, and whether it needs them; `**edges` stands for `EDGES`."""
    found: dict[str, bool] = {}
    for p in inspect.signature(function).parameters.values():
        if p.kind is p.KEYWORD_ONLY and not isinstance(p.default, bool):
            found[p.name] = p.default is p.empty
        elif p.kind is p.VAR_KEYWORD:
            found |= dict.fromkeys(EDGES, False)
    return found


def missing(function: Callable[..., Any], drive: Mapping[str, float]) -> tuple[str, ...]:
    """What a `make_params` cannot do without and is neither in a drive's table nor in `DEFAULTS`."""
    needed = keyword_parameters(function).items()
    return tuple(name for name, must in needed if must and name not in drive and name not in DEFAULTS)


def chosen(function: Callable[..., Any], drive: Mapping[str, float]) -> dict[str, float]:
    """The keyword arguments of a `make_params` from a drive's table or `DEFAULTS`, float32."""
    table = {**DEFAULTS, **drive}
    return {name: float(np.float32(table[name])) for name in keyword_parameters(function) if name in table}


def _of(module: ModuleType, short: str, source: str, signature: Callable[..., Any] | None = None) -> Entry:
    name = module.__name__.rpartition(".")[2]
    make = module.make_params
    return Entry(name, short, source, module.init, module.run, make, signature or make)


def _nothing(*_: object) -> None:
    """What the average-speed approach remembers and is told: the front end has done it all."""


def _by_the_front_end(
    params: None, state: None, samples: Samples, reset: NDArray[np.bool_]
) -> tuple[None, average_speed.Estimates]:
    return None, average_speed.Estimates(samples.theta_avg, samples.hall.omega)


_KIM = "Kim et al. 2011, DOI 10.1109/TIE.2010.2098367"
_ENTRIES = (
    Entry("average_speed", "avg", f"(1)-(2) of {_KIM}; [13]", _nothing, _by_the_front_end, _nothing, _nothing),
    _of(vector_tracking, "vt", f"(3)-(10) of {_KIM}"),
    _of(load_angle, "la", f"(3)-(10) with (18)-(19) of {_KIM}", vector_tracking.make_params),
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
