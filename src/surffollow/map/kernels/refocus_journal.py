"""Progress of a running MapRefocus in the header: its phase, the rows computed, and those not yet stored.

`journal_progress` holds the phase from bit 48 on, rows that wait in the ring in bits 40-47, and below them
the rows computed or, while grids are cleared, the grids.
"""

from __future__ import annotations

from typing import Any

from surffollow.shm.atomics import fence_release
from surffollow.shm.jit import jit, jit_inlined

FORWARD, TAIL, BACKWARD, HEAD, CLOSE = range(5)
_DONE_BITS, _PHASE_BIT = 40, 48
_DONE = (1 << _DONE_BITS) - 1
_WAITING = (1 << (_PHASE_BIT - _DONE_BITS)) - 1


@jit_inlined
def phase_of(w: Any) -> Any:
    """Phase of the running MapRefocus: FORWARD to CLOSE."""
    return w.journal_progress >> _PHASE_BIT


@jit_inlined
def finished_of(w: Any) -> Any:
    """Rows computed in this phase, or grids cleared."""
    return w.journal_progress & _DONE


@jit_inlined
def pending_of(w: Any) -> Any:
    """Rows of `finished_of` that still wait in the ring."""
    return (w.journal_progress >> _DONE_BITS) & _WAITING


@jit
def store_progress(w: Any, phase: Any, pending: Any, done: Any) -> None:
    """Write the progress, after what it speaks of and before what follows.

    Parameters
    ----------
    w : record of `MapHeader`  updated
    phase : int                FORWARD to CLOSE
    pending : int              rows computed that still wait in the ring
    done : int                 rows computed in this phase, or grids cleared
    """
    fence_release()
    w.journal_progress = (phase << _PHASE_BIT) + (pending << _DONE_BITS) + done
    fence_release()


@jit
def leave_rows(w: Any, phase: Any, pending: Any, done: Any, n_rows: Any, budget: Any) -> Any:
    """Go on to `phase` once all rows are stored; the budget that is left, above 0 when it went on.

    Parameters
    ----------
    w : record of `MapHeader`  updated
    phase : int                the phase that follows
    pending, done : int        progress of the present phase, as in `store_progress`
    n_rows : int               rows of the present phase
    budget : int               grids that this call may still work on
    """
    if done == n_rows and pending == 0:
        store_progress(w, phase, 0, 0)
        return max(budget, 1)
    return max(budget, 0)
