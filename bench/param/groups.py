"""The groups that a parameter may be in, by its flags. Without numpy: the command line names them in its help."""

from __future__ import annotations

from protocol.signals import Flag

GROUPS = {
    Flag.IDENTITY: "identity",
    Flag.CALIBRATION: "calibration",
    Flag.TUNING: "tuning",
    Flag.LIMITS: "limits",
}
"""A parameter's group by its flag, in the order in which groups are shown."""
OTHER = "other"
GROUP_NAMES = (*GROUPS.values(), OTHER)
GROUP_MEANINGS = {
    "identity": "which kind of motor this is",
    "calibration": "this very motor, its sensors and their mounting",
    "tuning": "gains, filters, choices",
    "limits": "what protects",
    "other": "without a group",
}
