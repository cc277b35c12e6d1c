"""The latched stop: causes found in a cycle, kept until the pose's holder resets them.

The rules are those of docs/reference/protocol.md, "Stop".

Causes from outside (requests, a driver's fault, a holder that died) come in through `latch_stop`, which the
service logs as a STOP entry; causes in the cycle's own status come from `Params.stop_on`. Both are replayed.
"""

from surffollow.shm import layout_follow as layout
from surffollow.shm.jit import jit, jit_inlined
from surffollow.shm.layout_adaptive import STUCK


@jit
def latch_stop(state, causes):
    """Stop, for these causes (bits of `STOP_NAMES`) beside those latched before.

    Parameters
    ----------
    state : (1,) record of `FollowState`, updated
    causes : int64, not 0
    """
    state[0].stop |= causes


@jit_inlined
def apply_stop(params, state, output):
    """Latch the causes that the configuration names; while stopped the demand is zero and not valid.

    A forecast that has not begun yet is without a reading, which is no loss. A tool that is stopped does not
    descend.
    """
    if output.status & layout.VALID:
        state.stop_armed = 1
    lost = output.status & layout.SENSOR_LOST and state.stop_armed != 0
    adaptive = params.mode == layout.MODE_ADAPTIVE
    stuck = adaptive and output.health == STUCK
    descends = adaptive and state.adaptive.descent.unexplained != 0 and state.stop == 0
    causes = layout.STOP_POSE_STALE if output.status & layout.POSE_STALE else 0
    causes |= layout.STOP_SENSOR_LOST if lost else 0
    causes |= layout.STOP_TOO_CLOSE if output.status & layout.TOO_CLOSE else 0
    causes |= layout.STOP_STUCK if stuck else 0
    causes |= layout.STOP_DESCENT if descends else 0
    output.stop_now = causes
    state.stop |= causes & params.stop_on
    output.stop = state.stop
    if state.stop != 0:
        output.status = (output.status & ~layout.VALID) | layout.STOPPED
        output.demand[:] = 0.0
