"""The configuration of the simulated bench: read from TOML, checked, frozen.

`sim/default.toml` describes the paper's motor; a user's file and overrides replace single keys of it. What none of
them gives follows from the motor (`sim.config.derive`). A
value outside its range, a key that does not exist and a file that cannot be read are a `ConfigError`: one
line with the name, the value, what is allowed, and the file and key.

The figures are those of `sim.config.sections`. This module knows no kernel and imports no numba.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sim.config import derive
from sim.config.contradictions import contradictions
from sim.config.errors import DEFAULTS, ConfigError, explain
from sim.config.sections import BenchParams

__all__ = ["BenchParams", "ConfigError", "Value", "load_params"]

Value = bool | int | float | str | list[Any] | tuple[float, ...]


def load_params(
    path: str | Path | None = None,
    overrides: Mapping[str, Value] | None = None,
    note: Callable[[str], None] = lambda text: None,
) -> BenchParams:
    """The bench of `default.toml`, with the keys of the TOML file `path` and then `overrides` in their place.

    What none of them gives follows from the motor.

    `overrides`: dotted keys such as `motor.R_s` or `firmware.vector_tracking.k_p_vt`. `note` gets a line for each
    contradiction. Raises `ConfigError`.
    """
    values: dict[str, Any] = {}
    sources: dict[str, str] = {}
    for file in (Path(__file__).parents[1] / DEFAULTS, *([Path(path)] if path is not None else [])):
        _put(_read(file), values, file.name, sources)
    for dotted, value in (overrides or {}).items():
        table: Any = value
        for key in reversed(dotted.split(".")):
            table = {key: table}
        _put(table, values, "overrides", sources)
    try:
        BenchParams.model_validate(values)
    except ValidationError as error:  # nothing can follow from what is wrong; what is missing follows
        if any(one["type"] != "missing" for one in error.errors()):
            raise explain(error, BenchParams, sources) from None
    derive.fill(values, sources)
    params = BenchParams.of(values, sources)
    for text in contradictions(params, sources):
        note(text)
    return params


def _read(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise ConfigError(f"no configuration file {path}") from None
    except ValueError as error:
        raise ConfigError(f"{path} is not valid TOML: {error}") from None
    except RecursionError:
        raise ConfigError(f"{path} is nested too deeply") from None
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from None


def _put(table: Mapping[str, Any], into: dict[str, Any], source: str, sources: dict[str, str], above: str = "") -> None:
    """Put the leaves of `table` in the place of those of `into`; `sources` gets their source by dotted key."""
    for key, value in table.items():
        sources[above + key] = source
        if not isinstance(into.get(key), dict):
            into[key] = value
        elif isinstance(value, Mapping):
            _put(value, into[key], source, sources, f"{above}{key}.")
        else:
            raise ConfigError(f"{above}{key} is a section, got {value!r} (in {source})")
