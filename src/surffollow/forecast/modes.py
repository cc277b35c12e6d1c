"""Modes of the default follower that the parameters give."""

from surffollow.shm.jit import jit_inlined
from surffollow.shm.layout_follow import RUN_FREEZE


@jit_inlined
def orients(params):
    """Whether there are three or more sensors, and the tool is rotated to the surface normal."""
    return params.orient != 0 and params.n_channels >= 3


@jit_inlined
def adapts(params):
    """Whether index, weights, noise and errors of predictions are adapted: not frozen, and not in FREEZE."""
    return params.adapt != 0 and params.run != RUN_FREEZE
