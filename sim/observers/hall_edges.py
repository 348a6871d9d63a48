"""Where the Hall edges lie, as parameters of the drive: what the observers that are told it have in common."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(frozen=True, kw_only=True)
class HallEdges:
    """Ideal less actual angle, electrical rad, of the edge that opens sector 1..6 as it is passed upwards, and of the
    same boundary passed downwards; 0: not known, or where an ideal sensor has it.
    """

    edge_up_1: float = 0.0
    edge_up_2: float = 0.0
    edge_up_3: float = 0.0
    edge_up_4: float = 0.0
    edge_up_5: float = 0.0
    edge_up_6: float = 0.0
    edge_down_1: float = 0.0
    edge_down_2: float = 0.0
    edge_down_3: float = 0.0
    edge_down_4: float = 0.0
    edge_down_5: float = 0.0
    edge_down_6: float = 0.0

    def places(self) -> list[float]:
        """The twelve, in the order of `EDGES`."""
        return [float(getattr(self, name)) for name in EDGES]


EDGES = tuple(field.name for field in fields(HallEdges))
"""Names of the twelve: the six upwards, then the six downwards."""
