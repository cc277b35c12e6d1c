"""Times of the beams' footprints: those of one round give a plane, and those of a beam that is late.

A beam may be late by a constant, with right timestamps. Its footprint then lies where the beam was at its own
time. It is of the plane under the tool as long as the tool has not travelled farther since than the ring is
wide.
"""

from surffollow.forecast.quantities import MISSING_NS
from surffollow.shm.jit import jit_inlined


@jit_inlined
def is_recent(beams, c, t_ns, late_ns=0):
    """Whether a beam has a sample of the same round as one with this timestamp, or late by no more [ns]."""
    return beams.t_ns[c] != 0 and abs(t_ns - beams.t_ns[c]) <= max(MISSING_NS, beams.round_ns) + late_ns


@jit_inlined
def lateness_ns(beams, c):
    """Usual lateness of a beam, as far as a footprint may be late [ns]."""
    return int(min(beams.late_s[c], beams.reach_s) * 1e9)
