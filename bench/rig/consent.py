"""The gate before a drive is energised: limits first, then an explicit act.

Nothing here sends a command. A simulated drive needs no act; everything else needs `--yes` or an answered prompt.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from bench.analysis.units import RPM
from bench.device.node import Node
from bench.errors import BenchError, UnsafeError
from protocol.messages import Feature

FLOAT32 = 1e-7  # to which a drive rounds its parameters, as a share


@dataclass(frozen=True, slots=True)
class Plan:
    """What is asked of the motor, at most: mechanical r/min, and A of load and of phase current (peak)."""

    speed_rpm: float
    load_a: float = 0.0
    current_a: float = math.inf
    """Whoever asks for less than the drive's `i_max` lowers that before the drive is energised."""


def check_limits(drive: Node, plan: Plan) -> None:
    """Raise BenchError, naming value and limit, if the plan exceeds what the drive allows."""
    if math.isfinite(plan.current_a):
        _check(drive, "--current", plan.current_a, "i_max", 1.0, "A")
    _check(drive, "--speed", plan.speed_rpm, "omega_m_max", RPM, "r/min")
    _check(drive, "--load", plan.load_a, "i_max", 1.0, "A")


def _check(drive: Node, option: str, value: float, parameter: str, unit: float, symbol: str) -> None:
    """`unit`: what one `symbol` is in the parameter's own unit. A drive without the parameter sets no limit here."""
    if not drive.has_parameter(parameter):
        return
    limit = drive.parameter(parameter).value / unit
    if not abs(value) <= limit * (1.0 + FLOAT32):
        raise BenchError(
            f"{option} {value:g} is beyond the drive's limit of {limit:.4g} {symbol} (its parameter {parameter})"
        )


def require_consent(drive: Node, target: str, plan: Plan, yes: bool, confirm: Callable[[str], bool] | None) -> None:
    """Raise UnsafeError unless the drive is simulated, `yes` was given, or `confirm` answers the question with True.

    `confirm` is None where nobody can be asked.
    """
    if drive.identity.features & Feature.SIMULATED or yes:
        return
    most = min(drive.parameter("i_max").value, plan.current_a) if drive.has_parameter("i_max") else None
    current = "its own limit" if most is None else f"{most:g} A"
    what = (
        f"{drive.identity.name} (boot {drive.identity.boot_id:08x}) on {target}: "
        f"up to {abs(plan.speed_rpm):g} r/min, phase current up to {current}"
    )
    if confirm is None:
        raise UnsafeError(f"will not spin {what}: nobody to ask, give --yes if the shaft is clear")
    if not confirm(f"Spin {what}. Is the shaft clear?"):
        raise UnsafeError("not confirmed: the drive was not energised")
