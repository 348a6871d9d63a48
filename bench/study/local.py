"""A scheduler and workers on this machine: `python -m bench.study.local WORKERS FOLDER`, as `bench.study.cluster` runs it.

It prints the scheduler's address, and ends with its standard input. Workers end with it, and are started again where
they have died alone. They keep their files in FOLDER, which it removes at the end.
"""

from __future__ import annotations

import asyncio
import os
import shutil
import sys
import threading

QUIET = {
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    "distributed.worker.profile.enabled": False,
    "distributed.worker.multiprocessing-method": "forkserver" if sys.platform == "linux" else "spawn",
    "distributed.nanny.pre-spawn-environ": {"OMP_NUM_THREADS": 1, "OPENBLAS_NUM_THREADS": 1, "MKL_NUM_THREADS": 1},
}
"""No pages, no samples of where a worker is, one thread each; fork of a process that has dask loaded is fastest."""


def main() -> None:
    """Run until standard input ends."""
    workers, folder = int(sys.argv[1]), sys.argv[2]
    threading.Thread(target=_end_with_input, args=(folder,), daemon=True).start()
    asyncio.run(_serve(workers, folder))


async def _serve(workers: int, folder: str) -> None:
    import dask
    from distributed import Nanny, Scheduler

    with dask.config.set(QUIET):
        async with Scheduler(host="127.0.0.1", port=0, dashboard=False, dashboard_address="127.0.0.1:0") as scheduler:
            print(scheduler.address, flush=True)
            options = {"nthreads": 1, "host": "127.0.0.1", "local_directory": folder, "memory_limit": 0}
            await asyncio.gather(*(Nanny(scheduler.address, **options) for _ in range(workers)))
            await scheduler.finished()


def _end_with_input(folder: str) -> None:
    sys.stdin.buffer.read()
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(0)


if __name__ == "__main__":
    main()
