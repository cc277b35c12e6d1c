"""Fault detection and isolation (FDI) of several beams.

Each beam gives a height under the tool by way of the known slopes. A beam that deviates from the median of
these heights by more than the gate is excluded. After some samples it is accepted again (the ground has
turned), unless three others agree on a plane or its own reading does not change.
"""

import math

from surffollow.forecast.pose import footprint, rotate
from surffollow.forecast.sensing.kinematics import predict_pose
from surffollow.shm.jit import jit

MAX_REFERENCE_AGE_NS = 12_000_000  # a beam older than the newest by this is no reference
MAX_AGE_NS = 25_000_000  # older footprints do not belong to the same plane
STUCK_NS, STUCK_SAMPLES = 100_000_000, 12.0  # a stuck beam repeats its range or keeps its mean so long
REPEAT_BAND = 0.25  # standard deviations: a range so near the first of a run repeats it; 1 of 7 by chance
MEAN_SAMPLES, BAND_SIGMAS = 8.0, 6.0  # in the mean; it is constant within so many standard deviations
GATE_SIGMAS, MIN_GATE_M = 8.0, 2e-3  # in standard deviations of a reading; least width of the gate
CONFIRMATION_SAMPLES = 5  # after so many outside the gate the ground has turned
BENT_GATE = 0.5  # root of the squared residuals of a plane, in gates: the beams lie on no plane
GRADUAL = 0.5  # deviation of the sample before, in gates: the beam sees ground that rises
WEIGHT_RECOVERY = 0.1  # per sample, of a beam that is accepted again
MIN_WEIGHT = 0.05  # of a beam accepted outside the gate


@jit
def has_deviated(beams, c):
    """Whether a beam was outside the gate lately, and has not been inside as often since."""
    return beams.outside_count[c] > 0


@jit
def choose_reference(params, beams, sense):
    """Choose the reference channel, whose samples are the follower's; -1: none.

    The present one stays while it delivers samples and is inside the gate.
    """
    newest = 0
    for c in range(params.n_channels):
        newest = max(newest, beams.t_ns[c])
    best, lowest = -1, 3
    for k in range(params.n_channels):
        c = (beams.reference + k) % params.n_channels
        if beams.t_ns[c] == 0:
            continue
        rank = 0
        if sense.valid[c] == 0 or newest - beams.t_ns[c] > MAX_REFERENCE_AGE_NS:
            rank = 2
        elif has_deviated(beams, c):
            rank = 1
        if rank < lowest:
            best, lowest = c, rank
    if best >= 0:
        beams.reference = best
    return best


@jit
def any_beam_changed(beams, n_channels, since_ns):
    """Whether a beam with a sample since a time did not repeat its range: not all are stuck."""
    changed = False
    for c in range(n_channels):
        changed |= beams.t_ns[c] > since_ns and beams.repeat_ns[c] == beams.t_ns[c]
    return changed


@jit
def observe_beams(params, adaptive, sense, pose):
    """Store the footprints of all fresh channels; returns the reference channel, or -1.

    Parameters
    ----------
    params, adaptive, sense : records of `Params`, `AdaptiveState` (updated), `SenseState`
    pose : (7,) float64  scratch
    """
    beams = adaptive.beams
    sigma = adaptive.noise.sigma_m
    band = BAND_SIGMAS * sigma / math.sqrt(MEAN_SAMPLES)
    for c in range(params.n_channels):
        if sense.fresh[c] == 0:
            continue
        t_ns, range_m = sense.range_t_ns[c] + adaptive.hold.shift_ns, sense.range_m[c]
        predict_pose(adaptive.kinematics, sense, t_ns, pose)
        x, y, z, _ = footprint(pose, params.tool_from_sensor, c, range_m)
        beams.footprint_m[3 * c], beams.footprint_m[3 * c + 1], beams.footprint_m[3 * c + 2] = x, y, z
        if beams.t_ns[c] == 0 or t_ns < beams.changed_ns[c]:
            beams.mean_m[c], beams.changed_ns[c], beams.repeat_ns[c] = range_m, 0, 0
        if beams.repeat_ns[c] == 0 or abs(range_m - beams.repeat_range_m[c]) > REPEAT_BAND * sigma:
            beams.repeat_range_m[c], beams.repeat_ns[c] = range_m, t_ns
        if range_m != beams.range_m[c]:  # a held value counts once
            beams.mean_m[c] += (range_m - beams.mean_m[c]) / MEAN_SAMPLES
        if beams.changed_ns[c] == 0 or abs(beams.mean_m[c] - beams.run_range_m[c]) > band:
            beams.run_range_m[c], beams.changed_ns[c] = beams.mean_m[c], t_ns
        beams.range_m[c], beams.t_ns[c] = range_m, t_ns
        # where the axis meets the ground at the wanted stand-off: accurate enough for the curvature
        dx, dy, _ = rotate(
            pose[3], pose[4], pose[5], pose[6], 0.0, 0.0, params.tool_from_sensor[2] - params.offset_m
        )
        beams.axis_x_m, beams.axis_y_m = pose[0] + dx, pose[1] + dy
    return choose_reference(params, beams, sense)


@jit
def _median(values, n):
    """Median of the first n values, which are sorted in place."""
    for i in range(1, n):
        v, j = values[i], i
        while j > 0 and values[j - 1] > v:
            values[j] = values[j - 1]
            j -= 1
        values[j] = v
    return values[n // 2] if n % 2 == 1 else 0.5 * (values[n // 2 - 1] + values[n // 2])


@jit
def half_squared_distance(beams, c):
    """Half the squared distance of a beam's footprint from the tool's axis [m²]."""
    dx, dy = beams.footprint_m[3 * c] - beams.axis_x_m, beams.footprint_m[3 * c + 1] - beams.axis_y_m
    return 0.5 * (dx * dx + dy * dy)


@jit
def beam_height(adaptive, c, x_m, y_m):
    """Height at (x, y) of the plane through a beam's footprint, corrected for the curvature [m].

    Parameters
    ----------
    adaptive : record of `AdaptiveState`
    c : int             channel
    x_m, y_m : float64  point in the world frame [m]
    """
    beams, plane = adaptive.beams, adaptive.plane
    dx, dy = beams.footprint_m[3 * c] - x_m, beams.footprint_m[3 * c + 1] - y_m
    return (
        beams.footprint_m[3 * c + 2]
        - plane.slope_x * dx
        - plane.slope_y * dy
        - plane.curvature * half_squared_distance(beams, c)
    )


@jit
def is_bent(adaptive, n_channels, gate_m):
    """Whether the accepted beams lie on no plane within the gate."""
    beams = adaptive.beams
    n, mx, my, mh = 0, 0.0, 0.0, 0.0
    for c in range(n_channels):
        if beams.accepted[c] != 0:
            n += 1
            mx += beams.footprint_m[3 * c]
            my += beams.footprint_m[3 * c + 1]
            mh += beams.height_m[c]
    mx, my, mh = mx / n, my / n, mh / n
    xx, xy, yy, xh, yh = 0.0, 0.0, 0.0, 0.0, 0.0
    for c in range(n_channels):
        if beams.accepted[c] != 0:
            dx, dy = beams.footprint_m[3 * c] - mx, beams.footprint_m[3 * c + 1] - my
            dh = beams.height_m[c] - mh
            xx, xy, yy = xx + dx * dx, xy + dx * dy, yy + dy * dy
            xh, yh = xh + dx * dh, yh + dy * dh
    determinant = xx * yy - xy * xy
    if not determinant > 1e-4 * (xx + yy) * (xx + yy):
        return False
    sx, sy = (yy * xh - xy * yh) / determinant, (xx * yh - xy * xh) / determinant
    squares = 0.0
    for c in range(n_channels):
        if beams.accepted[c] != 0:
            e = beams.height_m[c] - mh
            e -= sx * (beams.footprint_m[3 * c] - mx) + sy * (beams.footprint_m[3 * c + 1] - my)
            squares += e * e
    return squares > BENT_GATE * BENT_GATE * gate_m * gate_m


@jit
def accept_nearest(adaptive, n_channels, lowest_m):
    """Accept the beams that see the nearest ground; returns how many."""
    beams = adaptive.beams
    beams.inconsistent = 1
    good = 0
    for c in range(n_channels):
        if beams.accepted[c] == 0:
            continue
        if beams.height_m[c] < lowest_m:
            beams.accepted[c] = 0
            beams.weight[c] = 0.0
        else:
            beams.weight[c] = 1.0
            good += 1
    return good


@jit
def isolate_faults(adaptive, n_channels, t_ns, x_m, y_m):
    """Exclude beams outside the gate, weigh the others; returns how many are accepted.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (`beams` updated)
    n_channels : int    channels in use
    t_ns : int64        timestamp of the sample
    x_m, y_m : float64  point at which the heights are compared, world frame [m]
    """
    beams, plane = adaptive.beams, adaptive.plane
    n, repeating, constant, deviating = 0, 0, 0, 0
    stuck_ns = max(STUCK_NS, STUCK_SAMPLES * adaptive.prediction.interval_s * 1e9)
    for c in range(n_channels):
        beams.accepted[c] = 0
        if beams.t_ns[c] == 0 or abs(t_ns - beams.t_ns[c]) > MAX_AGE_NS:
            beams.weight[c] = 0.0
            continue
        beams.height_m[c] = beam_height(adaptive, c, x_m, y_m)
        beams.sorted_m[n] = beams.height_m[c]
        beams.accepted[c] = 1
        repeating += 1 if beams.t_ns[c] - beams.repeat_ns[c] > stuck_ns else 0
        constant += 1 if beams.t_ns[c] - beams.changed_ns[c] > stuck_ns else 0
        deviating += 1 if has_deviated(beams, c) else 0
        n += 1
    if n == 0:
        return 0
    median = _median(beams.sorted_m, n)
    gate = max(GATE_SIGMAS * adaptive.noise.sigma_m, MIN_GATE_M)
    agree = 0
    for c in range(n_channels):
        if beams.accepted[c] != 0 and abs(beams.height_m[c] - median) <= gate:
            agree += 1
    majority = agree >= 3 and plane.rank == 2
    nearest = beams.sorted_m[n - 1]
    apart = 2 * agree <= n and is_bent(adaptive, n_channels, gate)
    # beams that deviated may meet a good one by chance: the nearest ground has to agree as well
    if n >= 4 and plane.count > 0 and (apart or (beams.inconsistent != 0 and nearest > median + gate)):
        return accept_nearest(adaptive, n_channels, nearest - gate)
    beams.inconsistent = 0
    good = 0
    for c in range(n_channels):
        if beams.accepted[c] == 0:
            continue
        signed = (beams.height_m[c] - median) / gate
        # ground that rises under one beam leaves the gate gradually, a fault at once
        rises = signed > 1.0 and beams.deviation[c] > GRADUAL and not has_deviated(beams, c)
        beams.deviation[c] = signed
        deviation = 0.0 if rises else abs(signed)
        deviates = deviation > 1.0 and n >= 2 and plane.count > 0
        count = beams.outside_count[c] + (1 if deviates else -1)
        beams.outside_count[c] = min(max(count, 0), 2 * CONFIRMATION_SAMPLES)
        stuck = repeating == 1 and n >= 2 and beams.t_ns[c] - beams.repeat_ns[c] > stuck_ns
        alone = n >= 4 and deviating == (1 if has_deviated(beams, c) else 0)  # three good ones are left
        stuck |= alone and constant == 1 and beams.t_ns[c] - beams.changed_ns[c] > stuck_ns
        unconfirmed = deviates and beams.outside_count[c] <= CONFIRMATION_SAMPLES
        outvoted = majority and has_deviated(beams, c)
        if stuck or unconfirmed or outvoted:
            beams.outside_count[c] = max(beams.outside_count[c], 1)
            beams.accepted[c] = 0
            beams.weight[c] = 0.0
            continue
        full = max((1.0 - deviation * deviation) ** 2, MIN_WEIGHT) if deviation < 1.0 else MIN_WEIGHT
        beams.weight[c] = 1.0 if plane.count == 0 else min(full, beams.weight[c] + WEIGHT_RECOVERY)
        good += 1
    return good


@jit
def mean_height(adaptive, n_channels, x_m, y_m):
    """Weighted mean of the accepted beams' heights at (x, y) [m].

    Parameters
    ----------
    adaptive : record of `AdaptiveState`  at least one beam is accepted
    n_channels : int    channels in use
    x_m, y_m : float64  point in the world frame [m]
    """
    beams = adaptive.beams
    total, weights = 0.0, 0.0
    for c in range(n_channels):
        if beams.accepted[c] != 0:
            total += beams.weight[c] * beam_height(adaptive, c, x_m, y_m)
            weights += beams.weight[c]
    return total / weights


@jit
def release_beams(beams):
    """Forget that beams disagreed: they give no normal any more."""
    beams.inconsistent = 0


@jit
def note_first_sample(beams, t_ns):
    """Return the time of the first sample of the run, which may be this one [ns]."""
    if beams.first_ns == 0 or t_ns < beams.first_ns:
        beams.first_ns = t_ns
    return beams.first_ns
