"""Sample streams as a rig configures them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress

from bench.device.node import Node
from bench.errors import BenchError, DoesNotFit
from protocol.descriptor import Channel
from protocol.streams import MAX_DECIMATION, StreamConfig

_TOLERANCE = 1e-4  # rates are printed with six digits


def decimation_of(pwm_hz: int, rate_hz: float | None) -> int:
    """Return the decimation that makes this rate, 1 for None. Raises BenchError, naming the nearest, if none does."""
    if rate_hz is None:
        return 1
    decimation = round(pwm_hz / rate_hz)
    if decimation > MAX_DECIMATION:
        raise BenchError(f"--rate {rate_hz:g} Hz is too low; the lowest is {pwm_hz / MAX_DECIMATION:g} Hz")
    if decimation < 1 or not math.isclose(pwm_hz / decimation, rate_hz, rel_tol=_TOLERANCE):
        near = pwm_hz / max(decimation, 1)
        raise BenchError(f"--rate {rate_hz:g} Hz is not the PWM rate over a whole number; the nearest is {near:g} Hz")
    return decimation


def configure(
    node: Node, choices: Sequence[tuple[Channel, ...]], decimation: int = 1, slower: bool = False
) -> StreamConfig:
    """Configure the sample stream with the first of `choices` that the link carries at `decimation`.

    With `slower` the last one may come at the highest rate that fits. Raises DoesNotFit, with what
    would fit, and NodeError for channels or a rate that the node refuses.
    """
    for channels in choices[:-1]:
        with suppress(DoesNotFit):
            return node.set_samples(channels, decimation)
    channels = choices[-1]
    try:
        return node.set_samples(channels, decimation)
    except DoesNotFit as error:
        if not slower or not error.decimation:
            raise
        return node.set_samples(channels, error.decimation)
