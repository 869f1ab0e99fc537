"""`common.workers`: what is shared out comes back in order, whatever does it."""

import os

import pytest

from common import ipopt
from common.workers import Workers


def about(job):
    """A job's square, who did it, and that process's limit of a solve."""
    return job**2, os.getpid(), ipopt.limit["seconds"]


@pytest.mark.parametrize("number", [1, 2])
def test_jobs_come_back_in_order(number, monkeypatch):
    monkeypatch.setitem(ipopt.limit, "seconds", 7)
    with Workers(number) as workers:
        for jobs in ([], [3], list(range(21))):
            done = workers.map(about, jobs)
            assert [square for square, *_ in done] == [job**2 for job in jobs]
            assert all(limit == 7 for *_, limit in done)
    here = {process == os.getpid() for _, process, _ in done}
    assert here == {number == 1}


def test_closed_workers_do_nothing_more():
    workers = Workers(2)
    workers.close()
    with pytest.raises(RuntimeError, match="after shutdown"):
        workers.map(about, [1])
