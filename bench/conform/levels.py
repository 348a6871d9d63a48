"""The levels of the checks: each is run with all below it."""

from __future__ import annotations

LEVELS = ("link", "identity and parameters", "streams", "states and setpoints", "motion", "CAN")
"""Names of the levels, by number."""
LINK, IDENTITY, STREAMS, STATES, MOTION, CAN = range(len(LEVELS))
DEFAULT_LEVEL = STREAMS
"""Nothing is energised up to this one."""
