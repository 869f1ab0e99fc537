"""Ctrl-C, SIGTERM and the end of a terminal: how they stop a command.

A script imports this module before all others. Until `catch_signals` Ctrl-C ends the script without a traceback, since
nothing is there that could be lost.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from contextlib import contextmanager

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
GRACE = 2.0  # s after a signal in which no other interrupts; later ones do, as Python may lose a KeyboardInterrupt
ROOT = os.path.dirname(os.path.dirname(os.path.realpath(__file__)))

came: list[int] = []  # the signals so far
state = {"last": -GRACE, "is_saving": False}


def is_script() -> bool:
    """Whether this process runs a script of the root folder, and not another program that imports ours."""
    path = getattr(sys.modules["__main__"], "__file__", None)
    return path is not None and os.path.dirname(os.path.realpath(path)) == ROOT


if is_script() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def catch_signals():
    """Let each of `SIGNALS` raise KeyboardInterrupt. SIGHUP stays ignored under nohup."""
    for signum in SIGNALS:
        if signum in (signal.SIGINT, signal.SIGTERM) or signal.getsignal(signum) is not signal.SIG_IGN:
            signal.signal(signum, interrupt)


def interrupt(signum, _):
    """Raise KeyboardInterrupt, unless another signal has just done so or the work is being saved."""
    came.append(signum)
    now = time.monotonic()
    if state["is_saving"] or now - state["last"] < GRACE:
        return
    state["last"] = now
    raise KeyboardInterrupt


@contextmanager
def uninterrupted():
    """Let no signal interrupt the block."""
    before = state["is_saving"]
    state["is_saving"] = True
    try:
        yield
    finally:
        state["is_saving"] = before


def say(line: str):
    """Print a line. A terminal that is closed takes none, and no error follows."""
    try:
        print(line, flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # else Python fails when it ends


def leave():
    """End this process after a KeyboardInterrupt, with the status that shells give to the first signal."""
    for signum in SIGNALS:
        signal.signal(signum, signal.SIG_IGN)  # Python's end would let another one set another status
    sys.exit(128 + (came[0] if came else signal.SIGINT))
