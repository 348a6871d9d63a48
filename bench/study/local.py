"""A scheduler and workers on this machine, for `bench.study.cluster`: `python -m bench.study.local WORKERS FOLDER`.

It prints the scheduler's address, and ends with its standard input. Workers end with it, and are started again where
they have died alone. They keep their files in FOLDER, which it removes at the end.
"""

from __future__ import annotations

import asyncio
import os
import shutil
import sys
import threading
from typing import Any

METHOD = "forkserver" if sys.platform == "linux" else "spawn"
QUIET = {
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.gil.enabled": False,
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.scheduler.work-stealing": False,
    "distributed.worker.multiprocessing-method": METHOD,
}
"""No pages, and nothing that watches workers closely: that takes a few percent of a core for each of them."""


def main() -> None:
    """Run until standard input ends."""
    workers, folder = int(sys.argv[1]), sys.argv[2]
    os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
    threading.Thread(target=_end_with_input, args=(folder,), daemon=True).start()
    if METHOD == "forkserver":  # it loads what workers need while this process does
        from multiprocessing import forkserver, set_forkserver_preload

        set_forkserver_preload(["distributed", "bench.study.worker"])
        forkserver.ensure_running()
    asyncio.run(_serve(workers, folder))


async def _serve(workers: int, folder: str) -> None:
    import dask
    from distributed import Nanny, Scheduler

    with dask.config.set(QUIET):
        async with Scheduler(host="127.0.0.1", port=0, dashboard=False, dashboard_address="127.0.0.1:0") as scheduler:
            print(scheduler.address, flush=True)
            options: dict[str, Any] = {"nthreads": 1, "host": "127.0.0.1", "local_directory": folder, "memory_limit": 0}
            await asyncio.gather(*(Nanny(scheduler.address, **options) for _ in range(workers)))
            await scheduler.finished()


def _end_with_input(folder: str) -> None:
    sys.stdin.buffer.read()
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(0)


if __name__ == "__main__":
    main()
