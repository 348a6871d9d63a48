"""Replay of ten observers from file to file, and score: CPU time for a minute of all channels at 16 kHz."""

from __future__ import annotations

from pathlib import Path

import probe
import recorded

SECONDS, REPEAT = 60.0, 3

if __name__ == "__main__":
    replayed = ("bench.replay.replay", "bench.observers.replay")
    costs = {}
    if probe.there(*replayed):
        replay = probe.newest(*replayed).replay
        score = probe.newest("bench.score.board", "bench.scoring.board").score
        run, out = recorded.run("all.run", SECONDS, True), probe.FOLDER / "out.run"
        names = len(probe.newest("sim.observers.catalogue").CATALOGUE)
        took = probe.best(REPEAT, lambda: replay(Path(run), out=out, overwrite=True))
        costs[f"replay of {names} observers, file to file, a recorded second, ms"] = 1e3 * took / SECONDS
        took = probe.best(REPEAT, lambda: score([run]))
        costs[f"score of {2 * names} estimates, a recorded second, ms"] = 1e3 * took / SECONDS
    probe.tell(costs)
