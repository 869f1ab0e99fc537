"""IPOPT in CasADi, and Ctrl-C while it runs."""

from __future__ import annotations

import signal
import threading
from contextlib import contextmanager


@contextmanager
def interruptible():
    """Raise at the block's end what a handler of SIGINT or SIGTERM raised within it, even where CasADi swallowed it.

    That is KeyboardInterrupt by default. CasADi takes it for one more failure of IPOPT, returns nothing, raises a
    RuntimeError, or, where it tries an argument's types, passes over it.
    """
    raised: list[BaseException] = []
    within = True  # a signal that comes while the handlers are put back waits for that

    def noted(handler):
        def note(signum, frame):
            try:
                handler(signum, frame)
            except BaseException as error:
                raised.append(error)
                if within:
                    raise

        return note

    handlers = {}
    if threading.current_thread() is threading.main_thread():  # the only one that signals reach
        handlers = {signum: signal.getsignal(signum) for signum in (signal.SIGINT, signal.SIGTERM)}
        handlers = {signum: handler for signum, handler in handlers.items() if callable(handler)}
    try:
        for signum, handler in handlers.items():
            signal.signal(signum, noted(handler))
        yield
    except Exception:
        if not raised:
            raise
    finally:
        within = False
        for signum, handler in handlers.items():
            signal.signal(signum, handler)
    if raised:
        raise raised[0]
