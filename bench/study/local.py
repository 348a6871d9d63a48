"""A scheduler and workers on this machine, for `bench.study.cluster`: `python -m bench.study.local WORKERS FOLDER`.

It prints the scheduler's address, and ends with its standard input. Workers end with it, and are started again where
they have died alone. They keep their files in FOLDER, which it removes at the end.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import shutil
import sys
import threading
from contextlib import suppress
from multiprocessing.connection import Connection

METHOD = "forkserver" if sys.platform == "linux" else "spawn"
HOST = "127.0.0.1"
POLL = 0.1  # s between two looks at workers
QUIET = {
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.gil.enabled": False,
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.scheduler.work-stealing": False,
}
"""No pages, and nothing that watches workers closely: that takes a few percent of a core for each of them."""


def main() -> None:
    """Run until standard input ends."""
    workers, folder = int(sys.argv[1]), sys.argv[2]
    os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
    threading.Thread(target=_end_with_input, args=(folder,), daemon=True).start()
    if METHOD == "forkserver":  # it loads what workers need while this process does
        from multiprocessing import forkserver

        multiprocessing.set_forkserver_preload(["distributed", "bench.study.worker"])
        forkserver.ensure_running()
    asyncio.run(_serve(workers, folder))


async def _serve(workers: int, folder: str) -> None:
    import dask
    from distributed import Scheduler

    dask.config.set(QUIET)
    async with Scheduler(host=HOST, port=0, dashboard=False, dashboard_address=f"{HOST}:0") as scheduler:
        print(scheduler.address, flush=True)
        await asyncio.gather(*(_keep(scheduler.address, folder) for _ in range(workers)))


async def _keep(scheduler: str, folder: str) -> None:
    """A worker, and another one where it has ended."""
    context = multiprocessing.get_context(METHOD)
    while True:
        theirs, ours = context.Pipe(duplex=False)
        worker = context.Process(target=_work, args=(scheduler, folder, theirs))  # type: ignore[attr-defined]
        with theirs, ours, suppress(OSError, EOFError):  # as where the server of forks has just died
            worker.start()
            theirs.close()
            while worker.is_alive():
                await asyncio.sleep(POLL)
        await asyncio.sleep(POLL)


def _work(scheduler: str, folder: str, parent: Connection) -> None:
    """A worker, in a process of its own, until `parent` is closed."""
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    asyncio.run(_worker(scheduler, folder))


async def _worker(scheduler: str, folder: str) -> None:
    import dask
    from distributed import Worker

    dask.config.set(QUIET)
    async with Worker(
        scheduler, nthreads=1, memory_limit=0, dashboard=False, host=HOST, local_directory=folder
    ) as worker:
        await worker.finished()


def _end_with(parent: Connection) -> None:
    with suppress(OSError, EOFError):
        parent.recv()
    os._exit(0)


def _end_with_input(folder: str) -> None:
    sys.stdin.buffer.read()
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(0)


if __name__ == "__main__":
    main()
