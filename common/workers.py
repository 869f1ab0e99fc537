"""Processes that share the jobs of a solve, which changes only the time."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from common.ipopt import limit


class Workers:
    """`number` processes that do jobs until `close` or the end of a `with`. With 1, this process does the jobs.

    The processes are spawned, which is safe beside the threads of other libraries. They start with the first jobs, and
    have this process's time limit of a solve.
    """

    def __init__(self, number: int):
        self.number = number
        self.pool = None
        if number > 1:
            self.pool = ProcessPoolExecutor(number, get_context("spawn"), set_limit, (limit["seconds"],))

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()

    def close(self):
        if self.pool:
            self.pool.shutdown()

    def map(self, function: Callable, jobs: list) -> list:
        """[function(job) for each job], in the jobs' order."""
        if not self.pool:
            return [function(job) for job in jobs]
        chunk = -(-len(jobs) // (4 * self.number)) or 1
        return list(self.pool.map(function, jobs, chunksize=chunk))


def set_limit(seconds: float):
    """Set this process's limit. `limit.update` would not do, because a spawned process would get a copy of `limit`."""
    limit["seconds"] = seconds
