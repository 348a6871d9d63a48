"""What each application needs of a drive: the one table of names, and the one check.

A host assumes nothing that is not in the descriptor (chapter 9 of the specification). So what an application cannot do
without stands here, is looked for before anything is energised, and what is missing is named in one message. What it
can do without is done without.
"""

from __future__ import annotations

from collections.abc import Iterable

from bench.device.node import Node
from bench.errors import NodeError
from bench.signal.channels import flagged, reference_angle
from bench.signal.sources import source_number
from bench.signal.units import pole_pairs
from protocol.messages import Feature
from protocol.signals import AngleSource, Flag, Unit

NEEDS: dict[str, tuple[str, ...]] = {
    "the show": tuple(f"parameter:{name}" for name in ("n_p", "psi_f_hat", "observer", "omega_m_max", "i_max")),
    "bench response": (
        "feature:COMMISSION",
        "feature:WAVEFORM",
        *(f"parameter:{name}" for name in ("test", "test_length", "test_periods", "test_current", "test_speed")),
    ),
    "bench commission": (
        "feature:COMMISSION",
        *(f"channel:{name}" for name in ("i_a", "i_b", "i_c", "u_alpha", "u_beta", "u_dc", "theta_ctrl", "status")),
        *(f"parameter:{name}" for name in ("forced", "forced_angle", "test", "test_periods", "test_voltage")),
        *(f"parameter:{name}" for name in ("u_test_max", "R_s_hat", "L_s_hat", "bw_current")),
    ),
    "--load": ("parameter:n_p", "parameter:psi_f_hat"),
    "bench hall check": ("channel:hall", "feature:EDGES", "parameter:n_p", "speed"),
    "bench hall check --passive": ("channel:hall", "feature:EDGES"),
    "bench hall learn --write": tuple(
        f"parameter:edge_{way}_{sector}" for way in ("up", "down") for sector in range(1, 7)
    ),
    "bench hall learn --store": ("feature:COMMIT",),
    "bench hall learn --by filter": tuple(
        f"channel:{name}" for name in ("hall", "u_alpha", "u_beta", "i_a", "i_b", "i_c")
    ),
    "bench hall learn --by drive": tuple(
        f"channel:{name}" for name in ("lesson_ek", "lesson_value_ek", "lesson_sigma_ek", "sensors_ek")
    ),
}
"""By application or option. Each need is KIND:NAME or a role:

- `channel:NAME`, `parameter:NAME`, `feature:NAME`: of this name in the descriptor or HELLO;
- `encoder`: an angle with the flag REFERENCE; `speed`: a speed with the flag REFERENCE or ESTIMATE;
- `observer:NAME`: an angle source that the parameter `observer` can be set to.
"""


def lacks(node: Node, need: str) -> str:
    """What `node` lacks of one need, in words; empty if it has it. ValueError for a need of no known kind."""
    kind, _, name = need.partition(":")
    channels = node.descriptor.channels
    match kind:
        case "channel":
            return "" if any(c.name == name for c in channels) else f"the channel {name}"
        case "parameter" if name == "n_p" and node.has_parameter(name):
            value = node.parameter(name).value
            return "" if pole_pairs({name: value}) else f"a parameter n_p that a motor can have (it is {value:g})"
        case "parameter":
            return "" if node.has_parameter(name) else f"the parameter {name}"
        case "feature":
            return "" if Feature[name] & node.identity.features else f"the feature {name}"
        case "encoder":
            return "" if reference_angle(channels) else "an encoder (an angle with the flag REFERENCE)"
        case "speed":
            has = flagged(channels, Unit.RAD_PER_S, Flag.REFERENCE, Flag.ESTIMATE)
            return "" if has else "a speed with the flag REFERENCE or ESTIMATE"
        case "observer":
            return "" if offers(node, name) else f"the angle source {name} (parameter observer)"
    raise ValueError(f"unknown need '{need}'")


def offers(node: Node, source: str) -> bool:
    """Whether the parameter `observer` of `node` can be set to this angle source, by its name."""
    if not node.has_parameter("observer") or (not node.encoder and source_number(source) == AngleSource.ENCODER):
        return False
    allowed, number = node.parameter("observer"), source_number(source)
    return number is not None and allowed.lo <= number <= allowed.hi


def require(node: Node, what: str, needs: Iterable[str]) -> None:
    """Raise NodeError, with all that is missing in one message, unless `node` has what `what` needs."""
    missing = [words for need in needs if (words := lacks(node, need))]
    if missing:
        listed = missing[0] if len(missing) == 1 else f"{', '.join(missing[:-1])} and {missing[-1]}"
        raise NodeError(f"{what} needs {listed}; node {node.number} ({node.identity.name}) lacks it")
