"""What the drive tells of its Hall sensors in two ways that contradict each other: no sensor does that."""

from __future__ import annotations

from collections.abc import Iterator

from bench.findings.finding import Finding, percent
from bench.findings.thresholds import AT_RANDOM, CONTRADICT, EXCHANGED, FEW_RECORDS
from bench.signal.trace import Trace


def contradicting(trace: Trace) -> Iterator[Finding]:
    """EDGES records that do not follow from each other, or not from the codes of the samples."""
    told = trace.records
    share = told.broken / max(told.pairs, 1)
    if told.pairs >= FEW_RECORDS and share > CONTRADICT:
        exchanged = told.turned > EXCHANGED * told.pairs
        cause = (
            "wrong EDGES records: the codes before and after the edge are exchanged"
            if exchanged
            else "wrong EDGES records: the code before an edge is not the code after the edge before it"
        )
        evidence = [f"{told.broken} of {told.pairs} records do not go on from the one before ({percent(share)})"]
        if exchanged:
            evidence.append(f"with both exchanged, {percent(told.turned / told.pairs)} do")
        where = "bits 0-2 are the code before, bits 3-5 the code after"
        yield Finding(
            "edge_records",
            cause,
            tuple(evidence),
            f"mend the firmware: in byte 4 of an EDGES record {where} (SPEC, 11)",
        )
        return
    edges = trace.came + trace.lost_edges
    if trace.came and told.changes > AT_RANDOM * edges + FEW_RECORDS:
        yield Finding(
            "hall_codes",
            "the channel hall changes more often than there are Hall edges: one of them is not what the sensors do",
            (f"{told.changes} changes from sample to sample, {edges} edges",),
            "compare what the firmware puts into the channel hall with what its edge capture reads",
        )
    elif told.compared >= FEW_RECORDS and told.unlike > CONTRADICT * told.compared:
        share = told.unlike / told.compared
        yield Finding(
            "hall_codes",
            "the channel hall and the EDGES records contradict each other",
            (f"between two edges {told.unlike} of {told.compared} samples have another code ({percent(share)})",),
            "both are to have the codes with wires and polarities put right (SPEC, 12)",
        )
