"""What is told of a rig's drive and of the data that came from it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Quality:
    """What the data of a test are worth."""

    samples: int = 0
    edges: int = 0
    lost_samples: int = 0
    lost_edges: int = 0
    dropped_by_device: int = 0
    damaged_frames: int = 0
    outages: int = 0
    rate: float = 0.0
    """Samples a second."""
    seconds: float = 0.0
    """Device time from the first sample to the last."""
    remarks: tuple[str, ...] = ()
    """Each thing that made a stretch of data unfit, in words."""


@dataclass(frozen=True, slots=True)
class ParameterValue:
    """One parameter of the drive as it stood before the tests."""

    name: str
    value: float
    default: float
    unit: str
    about: str = ""
