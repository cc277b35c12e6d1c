"""Times of the beams' footprints: those of one round give a plane, and those of a beam that is late.

A beam may be late by a constant, with right timestamps. Its footprint then lies where the beam was at its own
time. It is of the plane under the tool as long as the tool has not travelled farther since than the ring is
wide.
"""

from surffollow.forecast.quantities import MISSING_NS
from surffollow.shm.jit import jit, jit_inlined


@jit_inlined
def round_ns(beams):
    """Footprints no farther apart are of one round [ns]."""
    return max(MISSING_NS, beams.round_ns)


@jit_inlined
def is_recent(beams, c, t_ns):
    """Whether a beam has a sample as new as one with this timestamp, or of the same round."""
    return beams.t_ns[c] != 0 and abs(t_ns - beams.t_ns[c]) <= round_ns(beams)


@jit_inlined
def lateness_ns(beams, c):
    """Usual lateness of a beam, as far as a footprint may be late [ns]."""
    return int(min(beams.late_s[c], beams.reach_s) * 1e9)


@jit
def is_near(beams, c, t_ns):
    """Whether a beam has a sample as new as one with this timestamp, its usual lateness taken off."""
    return beams.t_ns[c] != 0 and abs(t_ns - beams.t_ns[c]) <= round_ns(beams) + lateness_ns(beams, c)
