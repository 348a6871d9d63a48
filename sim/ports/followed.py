"""A simulated drive without a link that is given the commands of another one, period by period, and watched like it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.descriptor import Channel
from protocol.messages import DriveState, SetpointMode
from protocol.signals import Signal
from sim.config.params import load_params
from sim.drive.machine import SimulatedBench
from sim.plant import hall_sensor

LEAST_LOAD = 1e-6  # N m, below which the load machine is taken to be off


def pole_pair_means(pole_pair_deg: float, n_p: int) -> NDArray[np.float64]:
    """By how much each edge lies later, deg, (6,), in the mean of the pole pairs that `hall.pole_pair_deg` gives."""
    uneven, even = (
        hall_sensor.make_params((0.0,) * 6, 0.0, 0.0, n_p, pole_pair_deg=spread) for spread in (pole_pair_deg, 0.0)
    )
    places = np.array([[hall_sensor.edge_angle(of, k) for k in range(6 * n_p)] for of in (uneven, even)])
    means: NDArray[np.float64] = np.degrees(places[0] - places[1]).reshape(n_p, 6).mean(axis=0)
    return means


class Asked(NamedTuple):
    """What a drive is asked for over some PWM periods."""

    periods: int
    state: int
    """`DriveState`."""
    mode: int = 0
    """`SetpointMode`; 0: nothing asked for yet."""
    value: float = 0.0
    """SPEED: mechanical rad/s; CURRENT: i_q, A."""
    i_d: float = 0.0
    """A."""
    load: float = 0.0
    """N m against the shaft's positive direction."""


class Follower:
    """A drive with the figures of a configuration file, at rest; `channels` are what is wanted of it.

    `theta`: electrical rad, where its encoder has the rotor, less the firmware's `encoder_zero`; None: where the
    configuration has the rotor. Raises ConfigError.
    """

    def __init__(self, config: Path, theta: float | None, seed: int, channels: tuple[Channel | Signal, ...]) -> None:
        params = load_params(config)
        if theta is not None:
            theta_0_deg = math.remainder(math.degrees(theta) - params.encoder.offset_deg, 360.0)
            params = params.replace(mechanics=params.mechanics.replace(theta_0_deg=theta_0_deg))
        self.pwm_hz = params.clock.pwm_hz
        self._bench = SimulatedBench(params, seed)
        self._channels = channels
        self._bench.watch(frozenset(channel.name for channel in channels))
        self._asked = Asked(0, int(DriveState.IDLE))
        self.edges = 0
        """Hall edges so far."""

    @property
    def fault(self) -> str:
        """What its firmware has switched off for; empty as long as it has not."""
        return str(self._bench.faults.name) if self._bench.faults else ""

    def set(self, name: str, value: float) -> None:
        """A parameter of its firmware; one that it does not have is left alone."""
        if name in self._bench.parameters and self._bench.parameters[name] != np.float32(value):
            self._bench.set_param(name, value)

    def follow(self, asked: Asked) -> NDArray[np.void]:
        """Raw samples of the channels over its periods; zero for a channel that it does not have."""
        self._ask(asked)
        recorded = self._bench.advance(asked.periods)
        self.edges += len(recorded.edges)
        return recorded.raw(self._channels)

    def _ask(self, one: Asked) -> None:
        bench, before = self._bench, self._asked
        if one.state == DriveState.RUNNING != before.state:
            bench.enter_state(DriveState.ARMED)
        if one.state != before.state:
            bench.enter_state(DriveState(one.state))
        if one.mode and (one.state != before.state or one[2:5] != before[2:5]):
            bench.setpoint(SetpointMode(one.mode), one.value, one.i_d)
        if one.load != before.load:
            if (abs(one.load) > LEAST_LOAD) != (abs(before.load) > LEAST_LOAD):
                bench.load_enter_state(DriveState.RUNNING if abs(one.load) > LEAST_LOAD else DriveState.IDLE)
            bench.load_setpoint(SetpointMode.TORQUE, one.load)
        self._asked = one
