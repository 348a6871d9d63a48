"""Acceptance tests for drives: a pytest plug-in, measurements with limits, and a report.

    from bench.accept import energises, limit, needs

    @limit("error_std", "deg", hi=5.0)
    @needs("encoder")
    @energises(rpm=500, current=4)
    def test_steady_500_rpm(drive, record, measure):
        drive.start("vector-tracking")
        drive.speed(rpm=500)
        record.wait(0.5)
        steady = record(1.0)
        measure("error_std", np.degrees(steady.position_error("theta_vt").std()), steady)

`docs/acceptance.md` tells the rest. Importing this package opens nothing and, since every pytest of the
environment does it for the plug-in, loads next to nothing: the names come when they are asked for.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bench.accept.marks import called, energises, limit, limits, must_be_yes, needs, yes
    from bench.accept.results import Verdict
    from bench.rig.drive import Drive, DriveTripped
    from bench.rig.ratings import Ratings
    from bench.signal.capture import Capture
    from bench.signal.limits import RATED_CURRENT, RATED_SPEED, Limits
    from bench.signal.units import RPM

__all__ = [
    "RATED_CURRENT", "RATED_SPEED", "RPM", "Capture", "Drive", "DriveTripped", "Limits", "Ratings", "Verdict",
    "called", "energises", "limit", "limits", "must_be_yes", "needs", "yes",
]  # fmt: skip

_HOMES = {
    "RPM": "bench.rig.consent", "Capture": "bench.signal.capture",
    **dict.fromkeys(("Drive", "DriveTripped"), "bench.rig.drive"),
    **dict.fromkeys(
        ("called", "energises", "limit", "limits", "must_be_yes", "needs", "yes"), "bench.accept.marks"
    ),
    **dict.fromkeys(("Limits", "Verdict"), "bench.accept.results"),
    **dict.fromkeys(("RATED_CURRENT", "RATED_SPEED"), "bench.signal.limits"),
    "Ratings": "bench.rig.ratings",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    return getattr(import_module(_HOMES[name]), name)
