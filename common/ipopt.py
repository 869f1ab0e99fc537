"""IPOPT in CasADi: Ctrl-C while it runs, a limit in seconds, and a printed line if it takes long."""

from __future__ import annotations

import signal
import sys
import threading
import time
from contextlib import contextmanager

from common.interrupts import SIGNALS

PATIENCE = 5.0  # s until the line is printed
LEAST = 0.1  # s; less time counts as none, because IPOPT refuses a limit of 0
# Of a rocket for all tries of a solve, else for each one. `python baselines.py ID --solve-seconds` sets it.
limit = {"seconds": 120.0}


class SolveClock:
    """The seconds that all tries of one solve take. After `PATIENCE` one line says that the solve goes on."""

    def __init__(self, what: str):
        self.what = what
        self.began = time.monotonic()
        self.has_spoken = False

    def seconds(self) -> float:
        return time.monotonic() - self.began

    def seconds_left(self) -> float:
        """The seconds until the limit, 0 after it."""
        left = limit["seconds"] - self.seconds()
        return left if left > LEAST else 0.0

    def speak(self):
        """Print the line, once, on stderr."""
        if not self.has_spoken and self.seconds() > PATIENCE:
            self.has_spoken = True
            print(
                f"{self.what}: IPOPT is still solving; it stops after {limit['seconds']:g} s",
                file=sys.stderr,
                flush=True,
            )

    def callback(self, program: dict):
        """The callback for `nlpsol`, which CasADi calls after each iteration of IPOPT."""
        import casadi as ca

        clock = self

        class AfterIteration(ca.Callback):
            def __init__(self):
                ca.Callback.__init__(self)
                self.sizes = {"x": program["x"].numel(), "g": program["g"].numel()}
                self.construct("after_iteration", {})

            def get_n_in(self):
                return ca.nlpsol_n_out()

            def get_n_out(self):
                return 1

            def get_name_in(self, k):
                return ca.nlpsol_out(k)

            def get_name_out(self, k):
                return "stop"

            def get_sparsity_in(self, k):
                size = {"f": 1, "x": self.sizes["x"], "lam_x": self.sizes["x"]}
                size |= {"g": self.sizes["g"], "lam_g": self.sizes["g"]}
                return ca.Sparsity.dense(size.get(ca.nlpsol_out(k), 0), 1)

            def eval(self, arguments):
                clock.speak()
                return [0]

        self.kept = AfterIteration()  # CasADi does not keep it alive
        return self.kept


@contextmanager
def interruptible():
    """Raise at the block's end what a handler of a signal raised in the block, even if CasADi swallowed it.

    By default that is KeyboardInterrupt. CasADi may take it for a failure of IPOPT, return nothing, raise a
    RuntimeError, or ignore it while it tries the types of an argument.
    """
    raised: list[BaseException] = []
    within = True  # False while the handlers are put back, which a signal must not interrupt

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
    if threading.current_thread() is threading.main_thread():  # signals reach no other thread
        handlers = {signum: signal.getsignal(signum) for signum in SIGNALS}
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
