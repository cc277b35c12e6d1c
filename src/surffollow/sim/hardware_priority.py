"""Simulated hardware runs before other programs, as hardware does."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

FIFO_PRIORITY = 20  # above other programs, below any service


@contextlib.contextmanager
def hardware_priority() -> Iterator[None]:
    """Let this thread go before others meanwhile, where permitted: hardware does not wait for a busy machine.

    Programs and threads that it starts are not hardware: they begin at the usual priority.
    """
    before, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(FIFO_PRIORITY))
    try:
        yield
    finally:
        # a user without rights cannot take the reset at a fork back
        for policy in (before | os.SCHED_RESET_ON_FORK, before):
            with contextlib.suppress(OSError):
                os.sched_setscheduler(0, policy, parameters)
