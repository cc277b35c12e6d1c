"""Modes of the default follower that the parameters give."""

from surffollow.forecast.quantities import FULL_POWER_SAMPLES
from surffollow.shm.jit import jit_inlined
from surffollow.shm.layout_follow import RUN_FREEZE


@jit_inlined
def orients(params):
    """Whether there are three or more sensors, and the tool is rotated to the surface normal."""
    return params.orient != 0 and params.n_channels >= 3


@jit_inlined
def learns(params, adaptive):
    """Whether the follower learns: it is not frozen, or has not learned enough to be."""
    return params.adapt != 0 or adaptive.weights.scored < FULL_POWER_SAMPLES


@jit_inlined
def adapts(params, adaptive):
    """Whether index, weights, noise and errors of predictions are adapted: it learns, not in FREEZE."""
    return learns(params, adaptive) and params.run != RUN_FREEZE
