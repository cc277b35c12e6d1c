"""Two channels of a ring that are swapped: the check at commissioning finds them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow import Follower

from .tilted import rotated, turned

MS, STANDOFF_M, TURN_DEG = 1_000_000, 0.1, 5.0
RING = [
    (0.03 * math.cos(a), 0.03 * math.sin(a), 0.0) for a in (0.0, 2.0 * math.pi / 3.0, 4.0 * math.pi / 3.0)
]


def normal_moves_deg(places, order, pitch: bool) -> float:
    """Angle of the normal from the vertical over level ground when the tool has been turned [degrees]."""
    sensors = [{"near_m": 0.02, "far_m": 0.25, "position_m": list(p)} for p in places]
    f, rng = Follower({"sensors": sensors}, offset_m=STANDOFF_M), np.random.default_rng(2)
    f.set_params(run="dryrun")
    for ms in range(0, 3000, 4):
        angle = TURN_DEG * min(max(1e-3 * ms - 1.0, 0.0), 1.0)
        q, t_ns = turned(angle) if pitch else turned(0.0, angle), 10**9 + ms * MS
        f.pose(t_ns, (0.0, 0.0, STANDOFF_M, *q))
        down = -rotated(q, (0.0, 0.0, -1.0))[2]
        ranges = [(STANDOFF_M + rotated(q, p)[2]) / down + 1e-4 * rng.standard_normal() for p in places]
        f.step(t_ns, [ranges[c] for c in order])
    return math.degrees(math.acos(min(f.state()["normal"][2], 1.0)))


@pytest.mark.parametrize(
    ("places", "swapped"),
    [(RING, (1, 0, 2)), ([(0.0, 0.0, 0.0), *RING], (0, 2, 1, 3))],
    ids=["3", "3 around one"],
)
def test_a_tool_turned_by_hand_shows_channels_that_are_swapped(places, swapped):
    """GIVEN level ground WHEN the tool is turned about x and about y THEN only a right normal stays."""
    right, wrong = (
        max(normal_moves_deg(places, order, pitch) for pitch in (False, True))
        for order in (tuple(range(len(places))), swapped)
    )
    print(f"the normal moves by {right:.1f} degrees, with swapped channels by {wrong:.1f}")
    assert right < 0.5
    assert wrong > TURN_DEG
