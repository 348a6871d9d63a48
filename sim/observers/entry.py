"""One observer as the catalogue knows it, and an observer at work.

What an observer's module has: `Settings`, a dataclass of the drive's parameters that it takes, by their names; the
NamedTuples of numbers `Params`, `State` and `Estimate`, the last beginning with `theta` and `omega`; `make_params`,
`init` and `step`. From `init` and `step` one function is compiled, when it is first asked for. The simulated drive
calls it within its loop, a sample at a time, where the control uses the observer, and after the loop for all others; a
host calls it on what was telemetered: the same machine code, so that the results agree bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from functools import cache, cached_property
from importlib import import_module
from types import MappingProxyType, ModuleType
from typing import Any, NamedTuple, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from sim.native import Cells, Native, Pointer, address, layout, native, specialised
from sim.numba_cache import source_stamp
from sim.observers.sample import INIT, Sample

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
    "edge_sd": 0.0087,  # rad
    "i_range": 20.0,  # A
}
"""What a parameter is where a drive has none of that name: the values of the simulated drive. Motor data have none."""


LONGEST = 5  # letters of a short name: channels have names of 16, as theta_<short>_host
VOLTAGE, CURRENT = ("u_alpha", "u_beta"), ("i_a", "i_b", "i_c")


class Needs(NamedTuple):
    """What an observer is given beside Hall codes and edges, as channels of a drive at every PWM period."""

    required: tuple[str, ...] = ()
    """It cannot do without."""
    helpful: tuple[str, ...] = ()
    """It can do without, at some cost: a `Sample` has 0 there, as with the outputs off."""
    without: Mapping[str, float] = MappingProxyType({})
    """Parameters that only say what `helpful` channels mean: what they are without these, unless a drive tells them."""

    @property
    def words(self) -> str:
        """What it is given, for people; in brackets what it can do without."""
        groups = {"voltages": VOLTAGE, "currents": CURRENT}
        must = [name for name, of in groups.items() if set(of) <= set(self.required)]
        may = [name for name, of in groups.items() if set(of) <= set(self.helpful)]
        return ", ".join(["edges", *must]) + (f" ({', '.join(may)})" if may else "")


EDGES_ALONE, WITH_VOLTAGE = Needs(), Needs(required=(*VOLTAGE, *CURRENT))


@dataclass(frozen=True)
class Entry:
    """One observer. `short`: its name in channels, as `theta_<short>`; `source`: where it comes from, in one line."""

    name: str
    short: str
    source: str
    init: Callable[[], Any]
    step: Callable[..., tuple[Any, Any]]
    make: Callable[[float, Any], Any]
    """`make(pwm_hz, settings)`: its constants."""
    settings: type[Any]
    """A dataclass: its fields are the drive parameters that it takes, by their names."""
    results: Mapping[str, str] = field(default_factory=dict)
    """Channels that carry other fields of its estimates, and which."""
    needs: Needs = WITH_VOLTAGE

    @classmethod
    def of(
        cls, module: ModuleType, short: str, source: str, name: str = "", needs: Needs = WITH_VOLTAGE, **results: str
    ) -> Entry:
        """The observer of a module. TypeError, naming what is missing, if it does not fit the interface."""
        own = name or module.__name__.rpartition(".")[2]
        wanted = ("init", "step", "make_params", "Settings")
        if lacking := [word for word in wanted if not hasattr(module, word)]:
            raise TypeError(f"it has no {', '.join(lacking)}")
        made = cls(own, short, source, module.init, module.step, module.make_params, module.Settings, results, needs)
        if not 0 < len(short) <= LONGEST:
            raise TypeError(f"its short name must have 1 to {LONGEST} letters, got '{short}'")
        made.function  # noqa: B018 - checks
        return made

    @cached_property
    def function(self) -> Native:
        """`run(params, state, samples, reset, n, estimates)` in compiled form."""
        return _over(self.init, self.step)

    @cached_property
    def kinds(self) -> tuple[Any, Any, Any]:
        """The NamedTuples of its constants, its state and its estimates."""
        return _kinds(self.step)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the drive parameters that it depends on."""
        return names(self.settings)

    @property
    def channels(self) -> dict[str, str]:
        """The channels that carry its results, and which field of its estimates each carries."""
        return {f"theta_{self.short}": "theta", f"omega_{self.short}": "omega", **self.results}

    def missing(self, drive: Mapping[str, float]) -> tuple[str, ...]:
        """Parameters that it cannot do without and that are neither in a drive's table nor in `DEFAULTS`."""
        return missing(self.settings, drive)

    def make_params(self, pwm_hz: float, drive: Mapping[str, float]) -> Any:
        """Its constants from a drive's whole parameter table, rounded to float32 as a drive stores them.

        What it does not need is ignored; what is not there comes from `DEFAULTS`. Nothing may be `missing`.
        """
        return self.make(pwm_hz, chosen(self.settings, drive))

    def start(self, params: Any) -> Observing:
        """The observer at work, nothing known yet."""
        return Observing(self, params)


class Observing:
    """An observer at work over samples, a portion at a time: its constants and what it remembers, in memory."""

    def __init__(self, entry: Entry, params: Any) -> None:
        kind, state, estimate = entry.kinds
        self.entry = entry
        self.dtype = layout(estimate)
        """Of its estimates."""
        self._function = entry.function
        self._params, self.state = Cells(kind), Cells(state)
        self._at = self._params.at, self.state.at
        self.params = params
        self._function(*self._at, 0, 0, INIT, 0)

    @property
    def params(self) -> Any:
        """Its constants."""
        return self._params.first

    @params.setter
    def params(self, params: Any) -> None:
        self._params.first = params

    def run(self, samples: NDArray[np.void], reset: NDArray[np.bool_]) -> NDArray[np.void]:
        """Its step over n records of `Sample`, shape (n,), and `init` before each where `reset`, shape (n,), is set.

        Returns records of its estimates, shape (n,).
        """
        estimates = np.empty(len(samples), self.dtype)
        self.step_over(address(samples), address(reset), len(samples), address(estimates))
        return estimates

    def step_over(self, samples: int, reset: int, n: int, estimates: int) -> None:
        """The same by addresses."""
        self._function(*self._at, samples, reset, n, estimates)

    def loop(self, estimates: int) -> tuple[int, int, int, int, int]:
        """What `sim.drive.tick.advance` takes to step it within its loop, into `estimates`."""
        return self._function.address, *self._at, estimates, self.dtype.itemsize


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


def _kinds(step: Any) -> tuple[Any, Any, Any]:
    """Classes of constants, state and estimates, by the annotations of `step`; TypeError if they will not do."""
    plain = getattr(step, "py_func", step)
    params, state, sample, result = (*get_type_hints(plain).values(), None, None, None, None)[:4]
    if sample is not Sample or len(get_args(result)) != 2 or get_args(result)[0] is not state:
        raise TypeError("its step must be step(params: Params, state: State, sample: Sample) -> tuple[State, Estimate]")
    estimate = get_args(result)[1]
    for kind in (params, state, estimate):
        if not hasattr(kind, "_fields"):
            raise TypeError(f"{kind} must be a NamedTuple of numbers")
    if list(get_type_hints(estimate).items())[:2] != [("theta", float), ("omega", float)]:
        raise TypeError("its Estimate must begin with theta: float and omega: float")
    return params, state, estimate


@cache
def _over(init: Any, step: Any) -> Native:
    params, state, estimate = _kinds(step)
    pointer: Any = Pointer
    kinds = pointer[params], pointer[state], pointer[Sample], pointer[np.uint8], int, pointer[estimate]
    annotations = dict(zip(_each.__code__.co_varnames, kinds, strict=False))
    module = step.__module__
    name = f"{_each.__name__}_{module.rpartition('.')[2]}{source_stamp(module)}"
    return native(specialised(_each, name, annotations, init=init, step=step), f"{__name__}:function_of:{module}")


def function_of(module: str) -> Native:
    """`run(params, state, samples, reset, n, estimates)` of the observer in this module."""
    home = import_module(module)
    return _over(home.init, home.step)


def _each(params, state, samples, reset, n, estimates):  # type: ignore[no-untyped-def]
    """`step` over n samples, with `init` before each where `reset` is set; n = `INIT`: only `init`."""
    constants = params[0]
    now = init() if n == INIT else state[0]
    for k in range(n):
        if reset[k] != 0:
            now = init()
        now, estimates[k] = step(constants, now, samples[k])
    state[0] = now


init: Any = None  # in `_each` an observer's
step: Any = None
