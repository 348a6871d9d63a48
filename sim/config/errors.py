"""Why a configuration is refused: what pydantic found, as one line for the user.

This module knows no key by name. What a number must be is the description of its field.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from typing import cast, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

DEFAULTS = "default.toml"
DERIVED = "what follows from the motor and the inverter"
"""Where a value is from that no file gives: `sim.config.derive`."""


class ConfigError(Exception):
    """A configuration that cannot be used. `str(error)` is one line for the user."""


def explain(error: ValidationError, model: type[BaseModel], sources: Mapping[str, str]) -> ConfigError:
    """What is wrong with values for `model`, unknown keys first; `sources` has the files of dotted keys, or nothing."""
    order = {"extra_forbidden": 0, "missing": 2}
    found = min(error.errors(include_url=False), key=lambda one: order.get(one["type"], 1))
    kind, given = found["type"], found["input"]
    keys = [key for key in found["loc"] if isinstance(key, str)]
    dotted = ".".join(keys)
    if kind == "value_error":  # a rule between several keys
        return ConfigError(f"{found['ctx']['error']}{_blamed(dotted, sources)}")
    for key in keys[:-1]:
        model = cast("type[BaseModel]", model.model_fields[key].annotation)
    name, source = keys[-1], sources.get(dotted, "")
    if kind == "extra_forbidden":
        return ConfigError(f"unknown key {dotted} in {source}; {_hint(keys, list(model.model_fields))}")
    field = model.model_fields[name]
    for k in found["loc"][len(keys) :]:
        name, field = f"{name}[{k}]", FieldInfo.from_annotation(get_args(field.annotation)[0])
    whole = "a whole number " if field.annotation is int else ""
    got = f"{given:g}" if isinstance(given, float) else repr(given)
    where = f" ({dotted} in {source})" if source else ""
    return ConfigError(f"{name} must be {whole}{field.description}, got {got}{where}")


def _blamed(section: str, sources: Mapping[str, str]) -> str:
    if not sources:
        return ""
    given = {source for key, source in sources.items() if key.startswith(f"{section}." if section else "")}
    files = ", ".join(sorted(given - {DEFAULTS, DERIVED})) or DEFAULTS
    return f" ({section} in {files})" if section else f" (in {files})"


def _hint(keys: Sequence[str], known: Sequence[str]) -> str:
    *above, key = keys
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
    near += [name for name in known if name.lower() == key.lower()]  # case alone can put a short name out of reach
    return f"did you mean {'.'.join([*above, near[0]])}?" if near else f"allowed here: {', '.join(known)}"
