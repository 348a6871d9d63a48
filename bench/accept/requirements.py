"""Whether a rig has what a test says that it needs. Nothing here changes the rig, or asks the drive anything new."""

from __future__ import annotations

from bench.accept import faults
from bench.errors import BenchError
from bench.rig.loads import SPEED
from bench.rig.needs import lacks
from bench.rig.rig import Rig

PHASES, DQ = ("i_a", "i_b", "i_c"), ("i_d", "i_q")


def missing(what: str, rig: Rig) -> str | None:
    """Why the rig has not `what`; None if it has. BenchError for what is nothing that a rig can have."""
    kind, _, value = what.partition(":")
    match kind:
        case "encoder":
            return None if rig.has_encoder else "needs an encoder: the drive streams no reference position"
        case "load":
            return None if rig.load.abilities else "needs a load"
        case "load.speed":
            return None if SPEED in rig.load.abilities else "needs a load that forces a speed"
        case "hall-faults":
            able = faults.offered(rig, faults.PARAMETERS) or rig.plan.ask is not None
            return None if able else "needs a rig that inserts faults of the Hall wiring, or a person who does"
        case "hall-placement":
            return None if faults.offered(rig, faults.PLACEMENT) else "needs a rig that moves the Hall sensors"
        case "rate":
            enough = rig.rate >= float(value)
            return None if enough else f"needs {value} samples a second; the link carries {rig.rate:g}"
        case "currents":
            streamed = {c.name for c in rig.channels}
            has = streamed.issuperset(PHASES) or streamed.issuperset(DQ)
            return None if has else f"needs the currents {', '.join(PHASES)} or {', '.join(DQ)}"
        case "channel":
            return None if value in {c.name for c in rig.channels} else f"needs the channel {value}"
        case "parameter" | "feature" | "observer" | "speed":
            words = lacks(rig.drive.node, what)
            return f"needs {words}" if words else None
    known = (
        "encoder, speed, currents, load, load.speed, hall-faults, hall-placement, rate:HZ, channel:NAME, "
        "parameter:NAME, feature:NAME, observer:NAME"
    )
    raise BenchError(f"@needs('{what}'): there are {known}")
