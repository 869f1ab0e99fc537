"""Processes that share the jobs of a solve, which changes only the time."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from types import ModuleType

from common.errors import NoOptimum
from common.ipopt import limit


def usable_cores() -> int:
    """The cores that this process may use. A batch system may allow fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Workers:
    """`number` processes that do jobs until `close` or the end of a `with`. With 1, this process does the jobs.

    The processes are spawned, which is safe beside the threads of other libraries. They start with the first jobs, and
    have this process's time limit of a solve. An error in the `with` kills them, and so does the end of this process.
    """

    def __init__(self, number: int):
        self.number = number
        self.pool = None
        if number > 1:
            context = get_context("spawn")
            watched, self.held = context.Pipe(duplex=False)  # the workers see its end when this process ends
            arguments = limit["seconds"], watched
            self.pool = ProcessPoolExecutor(number, context, begin_worker, arguments)

    def __enter__(self):
        return self

    def __exit__(self, kind, error, traceback):
        if error is not None:
            self.kill()
        self.close()

    def close(self):
        if self.pool:
            self.pool.shutdown()
            self.held.close()

    def kill(self):
        """End the processes at once, whatever they do."""
        if self.pool:
            for process in list((self.pool._processes or {}).values()):
                process.kill()
            self.pool.shutdown(cancel_futures=True)

    def map(self, function: Callable, jobs: list) -> list:
        """[function(job) for each job], in the jobs' order. Raises NoOptimum if a process is lost."""
        if not self.pool:
            return [function(job) for job in jobs]
        chunk = -(-len(jobs) // (4 * self.number)) or 1
        try:
            with starting():
                found = self.pool.map(function, jobs, chunksize=chunk)
            return list(found)
        except BrokenProcessPool:
            why = "something else ended it, perhaps for lack of memory"
            raise NoOptimum(f"a process that solves is lost ({why}); fewer cores (taskset) need less") from None


@contextmanager
def starting():
    """Let processes that start within ignore Ctrl-C, and not run this process's script again.

    The jobs need only modules. A script may have no guard of its main part, or not be a file.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    has_masks = hasattr(signal, "pthread_sigmask")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT]) if has_masks else None
    try:
        yield
    finally:
        sys.modules["__main__"] = main
        if before is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def begin_worker(seconds: float, watched):
    """Set this process's limit, and let it end with the process that holds the other end of `watched`.

    `limit.update` would not do, because a spawned process would get a copy of `limit`.
    """
    limit["seconds"] = seconds
    threading.Thread(target=end_with, args=(watched,), daemon=True).start()


def end_with(watched):
    """End this process when the other end of `watched` is closed."""
    watched.poll(None)
    os._exit(1)
