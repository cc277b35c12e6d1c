"""Fault detection and isolation (FDI) of several beams.

Each beam gives a height under the tool by way of the known slopes. A beam that deviates from the median of
these heights by more than the gate is excluded. After some samples it is accepted again (the ground has
turned), unless three others agree on a plane, or that with it is too steep. One of three or four may be
blocked (`blocked_beam`). Without a majority the beams that see the nearest ground count.
"""

import math

from surffollow.forecast import quantities
from surffollow.forecast.attitude.beam_times import is_recent, lateness_ns
from surffollow.forecast.attitude.blocked_beam import TURNED_SAMPLES, beam_gate_m, is_blocked, observe_range
from surffollow.forecast.attitude.plane_regression import (
    farthest_half_squared,
    flat_height,
    half_squared_distance,
    is_bent,
    is_too_steep,
    odd_beam,
)
from surffollow.forecast.estimation.noise import estimated_range_noise_m
from surffollow.forecast.plant.observed_axis import predict_pose
from surffollow.forecast.pose import footprint
from surffollow.forecast.sensing.standoff import axis_ground_point
from surffollow.shm.jit import jit


@jit
def measure_round(params, adaptive):
    """Set the time in which beams that are read by turns each have a sample, LONG_GAP_NS at most.

    It is 0.9 of the shortest interval of a channel, of which eight beams by turns need 7/8. A beam that
    misses a round is not recent.
    """
    shortest_s = quantities.LONG_GAP_NS * 1e-9  # before a channel has a second reading, all are of one round
    for c in range(params.n_channels):
        if adaptive.health.interval_s[c] > 0.0:
            shortest_s = min(shortest_s, adaptive.health.interval_s[c])
    adaptive.beams.round_ns = int(0.9 * shortest_s * 1e9)


@jit
def measure_lateness(params, adaptive, sense):
    """Learn how far fresh beams are usually behind the reference; set how late a footprint may be.

    The tool may have travelled the radius of the ring since, and PAUSE_NS may have passed.
    """
    beams, reference_ns, farthest_m2 = adaptive.beams, adaptive.beams.t_ns[adaptive.beams.reference], 0.0
    for c in range(params.n_channels):
        if sense.fresh[c] != 0 and reference_ns != 0:
            late_s = max(reference_ns - beams.t_ns[c], 0) * 1e-9
            late_s = min(late_s, quantities.LONG_GAP_NS * 1e-9)
            beams.late_s[c] += (late_s - beams.late_s[c]) / quantities.USUAL_SAMPLES
        if is_recent(beams, c, reference_ns):
            farthest_m2 = max(farthest_m2, half_squared_distance(beams, c))
    radius_m, speed_mps = math.sqrt(2.0 * farthest_m2), adaptive.kinematics.speed_mps
    beams.reach_s = quantities.PAUSE_NS * 1e-9
    if radius_m < speed_mps * beams.reach_s:
        beams.reach_s = radius_m / speed_mps


@jit
def choose_reference(params, beams, sense):
    """Choose the reference channel, whose samples are the follower's; -1: none.

    The present one stays while it delivers samples and is accepted. A caller in process may give one channel
    per step: a channel without a range in this step is not silent. Of several others the newest one follows,
    so that there is a sample at once.
    """
    newest = max(beams.t_ns.max(), 0)
    if newest == 0:
        return -1
    best, lowest = beams.reference, 3
    for k in range(params.n_channels):
        c = (beams.reference + k) % params.n_channels
        silent = sense.window_n[c] == 0 or not is_recent(beams, c, newest)
        rank = 2 if silent else 1 - beams.accepted[c]
        newer = best != beams.reference and beams.t_ns[c] > beams.t_ns[best]
        if rank < lowest or (rank == lowest and newer):
            best, lowest = c, rank
    beams.reference = best
    return best


@jit
def observe_beams(params, adaptive, sense, pose):
    """Store the footprints of all fresh channels; returns the reference channel, or -1.

    Parameters
    ----------
    params, adaptive, sense : records of `Params`, `AdaptiveState` (updated), `SenseState`
    pose : (7,) float64  scratch
    """
    beams, band_m = adaptive.beams, quantities.REPEAT_BAND * estimated_range_noise_m(adaptive.noise)
    measure_round(params, adaptive)
    for c in range(params.n_channels):
        if sense.fresh[c] == 0:
            continue
        t_ns, range_m = sense.range_t_ns[c] + adaptive.hold.shift_ns, sense.range_m[c]
        predict_pose(params, adaptive, sense, t_ns, pose)
        x, y, z, sensor_z = footprint(pose, params.tool_from_sensor, c, range_m)
        beams.footprint_m[3 * c], beams.footprint_m[3 * c + 1], beams.footprint_m[3 * c + 2] = x, y, z
        changed = abs(range_m - beams.repeat_range_m[c]) > band_m
        if changed or beams.t_ns[c] == 0 or t_ns < beams.repeat_ns[c]:
            beams.repeat_range_m[c], beams.repeat_ns[c] = range_m, t_ns
        observe_range(params, adaptive, c, t_ns, range_m, sensor_z)
        beams.t_ns[c] = t_ns
        dx, dy, _ = axis_ground_point(params, pose, 0)  # accurate enough for the curvature
        beams.axis_x_m, beams.axis_y_m = pose[0] + dx, pose[1] + dy
    measure_lateness(params, adaptive, sense)
    return choose_reference(params, beams, sense)


@jit
def collect_heights(params, adaptive, t_ns, x_m, y_m):
    """Sorted heights at (x, y) by beams that are recent and not blocked; their number, and of repeating ones.

    Where these are fewer than three, beams that are late as usual count, too: without them there is no plane.
    Ground that moves would tilt it, because their heights are of an earlier time.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`beams` updated)
    t_ns : int64        timestamp of the sample
    x_m, y_m : float64  point in the world frame [m]

    Returns
    -------
    int64, int64
    """
    beams, plane = adaptive.beams, adaptive.plane
    timely, n, repeating, beams.blocked = 0, 0, 0, 0
    for c in range(params.n_channels):
        recent, blocked = is_recent(beams, c, t_ns), is_blocked(params, adaptive, c)
        beams.blocked += 1 if blocked else 0
        beams.old[c] = 1 if beams.t_ns[c] != 0 and not recent else 0
        timely += 1 if recent and not blocked else 0
        recent = recent or (beams.old[c] != 0 and is_recent(beams, c, t_ns, lateness_ns(beams, c)))
        beams.accepted[c] = 1 if recent and not blocked else 0
    for c in range(params.n_channels):
        if timely >= 3 and beams.old[c] != 0:
            beams.accepted[c] = 0
        if beams.accepted[c] == 0:
            continue
        dx, dy = beams.footprint_m[3 * c] - x_m, beams.footprint_m[3 * c + 1] - y_m
        height = flat_height(beams, plane.curvature, c) - plane.slope_x * dx - plane.slope_y * dy
        beams.height_m[c] = height
        k = n
        while k > 0 and beams.sorted_m[k - 1] > height:
            beams.sorted_m[k] = beams.sorted_m[k - 1]
            k -= 1
        beams.sorted_m[k] = height
        repeating += 1 if is_repeating(adaptive, c) else 0
        n += 1
    return n, repeating


@jit
def is_repeating(adaptive, c):
    """Whether a beam repeats its range for longer than chance explains: a drop-out and 12 intervals."""
    stuck_ns = quantities.MAX_GAP_NS + 12.0 * adaptive.hold.interval_s * 1e9
    return adaptive.beams.t_ns[c] - adaptive.beams.repeat_ns[c] > stuck_ns


@jit
def _is_outlier(adaptive, c, deviation, majority, known):
    """Whether a beam is excluded that deviates from the median by so many gates.

    Ground that rises under one beam leaves the gate gradually, and comes to the others.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (`beams` updated)
    c : int              the beam
    deviation : float64  above the median, over the gate
    majority : bool      three others agree on a plane, or that with it is too steep: it is never the ground
    known : bool         the slopes are known, or the beams lie on no plane
    """
    beams = adaptive.beams
    travel_m = adaptive.kinematics.speed_mps * adaptive.hold.interval_s
    beams.outside_m[c] = beams.outside_m[c] + travel_m if deviation > 1.0 else 0.0
    alone = beams.outside_m[c] <= 2.0 * math.sqrt(2.0 * half_squared_distance(beams, c))
    rises = deviation > 0.0 and beams.deviation[c] > 0.5 and beams.outside_count[c] == 0 and alone
    deviates = abs(deviation) > 1.0 and known and not rises
    beams.deviation[c] = deviation
    count = beams.outside_count[c] + (1 if deviates else -1)
    beams.outside_count[c] = min(max(count, 0), 2 * TURNED_SAMPLES)
    return (deviates and count <= TURNED_SAMPLES) or (majority and count > 0)


@jit
def near_beam_stays(params, beams, least_m):
    """Whether a beam has seen ground above a height [m] so often that it is no glitch."""
    stays = False
    for c in range(params.n_channels):
        near = beams.accepted[c] != 0 and beams.height_m[c] > least_m
        stays = stays or (near and beams.outside_count[c] >= TURNED_SAMPLES)
    return stays


@jit
def isolate_faults(params, adaptive, t_ns, x_m, y_m):
    """Exclude beams outside the gate, weigh the others; returns how many are accepted.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`beams` updated)
    t_ns : int64        timestamp of the sample
    x_m, y_m : float64  point at which the heights are compared, world frame [m]
    """
    beams, begun = adaptive.beams, adaptive.plane.count > 0
    n, repeating = collect_heights(params, adaptive, t_ns, x_m, y_m)
    median = 0.5 * (beams.sorted_m[(n - 1) // 2] + beams.sorted_m[n // 2])
    gate = beam_gate_m(params, adaptive)
    agree, good = 0, 0
    for k in range(n):
        agree += 1 if abs(beams.sorted_m[k] - median) <= gate else 0
    majority = agree >= 3 and adaptive.plane.rank == 2
    # ground that is nearer by a stand-off would have touched the tool: such a beam is wrong
    last, highest_m = max(n, 1) - 1, beams.sorted_m[(n - 1) // 2] + params.offset_m
    while last > 0 and beams.sorted_m[last] > highest_m:
        last -= 1
    nearest = beams.sorted_m[last]
    steep = agree < n and n > 2 and is_too_steep(params, adaptive)
    # ground as curved as a sphere of the stand-off leaves its plane so far under the farthest beam. Wide
    # rings meet such ground seldom, and faults as large do harm: a twentieth of the stand-off at most
    farthest_m2 = farthest_half_squared(params, beams)
    bend_m = max(gate, min(farthest_m2 / params.offset_m, 0.05 * params.offset_m))
    no_plane = steep or (agree < n and n > 3 and is_bent(adaptive, params.n_channels, bend_m))
    # over an edge at a start, and over one of three beams, the nearer ground counts: more are no majority
    stays = steep and agree < 3 and near_beam_stays(params, beams, median + gate)
    edge = not begun and no_plane and (nearest - median) ** 2 > 2.0 * farthest_m2
    counts = beams.inconsistent != 0 or stays or edge
    apart, odd = 2 * agree <= n or (counts and nearest > median + gate), -1
    majority, known = majority or steep, begun or no_plane
    if n < 3:  # a lost reading ends no disagreement at once
        beams.inconsistent = max(beams.inconsistent - 1, 0)
    elif not apart:
        beams.inconsistent = 0
    elif no_plane:
        # one wrong beam of six or more does not count against all others
        odd = odd_beam(adaptive, params.n_channels, gate) if n > 5 else -1
        # of a slow ring, or beams by turns, as many as come in the time in which a fault is over
        interval_ns = max(adaptive.hold.interval_s * 1e9, quantities.PAUSE_NS / quantities.SETTLED_SAMPLES)
        beams.inconsistent = max(int(quantities.PAUSE_NS / interval_ns), TURNED_SAMPLES) if odd < 0 else 0
    elif beams.inconsistent != 0:  # faulty beams lie on a plane with good ones by chance only, and seldom
        beams.inconsistent -= 1
    for c in range(params.n_channels):
        if beams.accepted[c] == 0:
            rejected = True
        elif odd >= 0:
            rejected = c == odd
        elif beams.inconsistent != 0:
            rejected = not nearest - gate <= beams.height_m[c] <= nearest
        else:
            outlier = _is_outlier(adaptive, c, (beams.height_m[c] - median) / gate, majority, known)
            rejected = outlier or (repeating == 1 and n >= 2 and is_repeating(adaptive, c))
        beams.accepted[c] = 0 if rejected else 1
        recovered = min(beams.weight[c] + 0.1, 1.0) if begun else 1.0  # it comes back within ten samples
        beams.weight[c] = 0.0 if rejected else recovered
        good += beams.accepted[c]
    return good


@jit
def release_beams(beams):
    """Forget which beams agree: they give no normal any more."""
    beams.inconsistent = beams.blocked = 0
    beams.accepted[:] = beams.old[:] = 0
