"""Response of the beams to the tool's own rotation: an active test of the sensors that give the normal.

Beams that repeat their ranges give a plane that turns with the tool: the deviation of its normal from the
tool's axis stays, and the tool turns on and on. A tool that follows curved ground with a lag has a constant
deviation, too. A rotation with a constant deviation that no lag explains is therefore tested: the tool turns
back by a little (`ROTATION_TEST`), and the deviation must grow by that, whether the ground goes on to curve
or not. If it does not, or the tool does not turn back in time, the tool does not turn (`ROTATION_FAILED`)
until the deviation changes.
"""

import math

from surffollow.forecast import elementary
from surffollow.forecast.attitude.beam_times import is_recent
from surffollow.forecast.attitude.plane_fit import slope_gain
from surffollow.forecast.estimation.noise import assumed_noise_m
from surffollow.forecast.pose import rotate, rotation_between, to_world
from surffollow.forecast.quantities import tolerated_gap_s
from surffollow.forecast.sensing.constant_ranges import ANSWER_TAUS, MIN_MEANS, MOTION_BANDS
from surffollow.forecast.sensing.mean_range import RUN_SAMPLES, TEST_BAND_FACTOR, is_suspicious
from surffollow.shm.jit import jit, jit_inlined
from surffollow.shm.layout_adaptive_sensing import ROTATION_FAILED, ROTATION_RUN, ROTATION_TEST
from surffollow.shm.layout_follow import RUN_NORMAL


@jit_inlined
def expected_range(params, c):
    """Range of a channel at the stand-off, over ground that is perpendicular to the tool's axis [m]."""
    at, mounts = 7 * c, params.tool_from_sensor
    _, _, beam_z = to_world(mounts, at, 0.0, 0.0, -1.0)
    distance_m = params.offset_m + mounts[at + 2] - mounts[2]  # of the sensor from the ground, along the axis
    return distance_m / max(-beam_z, 0.1)  # a beam that is nearly level says little about the distance


@jit
def mean_beam_range(params, beams, sense, t_ns, range_m):
    """Mean of the newest ranges of all beams [m]: constant only if none of them responds.

    Beams that are inclined, or mounted higher, count as if they were not: at the stand-off the mean is the
    stand-off.

    Parameters
    ----------
    params, beams, sense : records of `Params`, `Beams`, `SenseState`
    t_ns : int64       timestamp of the reference's sample
    range_m : float64  its range [m], returned while no beam is as new
    """
    total, n = 0.0, 0
    for c in range(params.n_channels):
        if is_recent(beams, c, t_ns):
            total, n = total + (sense.range_m[c] - expected_range(params, c)), n + 1
    return params.offset_m + total / n if n > 0 else range_m


@jit
def _begin_run(rotation, t_ns, axis):
    """Begin a run of constant deviations at the present mean."""
    rotation.phase, rotation.run_ns, rotation.samples = ROTATION_RUN, t_ns, 0
    rotation.run_mean[0], rotation.run_mean[1] = rotation.mean[0], rotation.mean[1]
    rotation.run_axis[0], rotation.run_axis[1], rotation.run_axis[2] = axis


@jit
def reset_rotation(rotation):
    """Begin anew with the next plane."""
    rotation.t_ns, rotation.phase = 0, ROTATION_RUN


@jit
def observe_rotation(params, adaptive, t_ns, pose):
    """Update the test with the newest plane.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`rotation` updated)
    t_ns : int64         timestamp of the sample
    pose : (7,) float64  pose at that time
    """
    rotation, plane = adaptive.rotation, adaptive.plane
    dt = (t_ns - rotation.t_ns) * 1e-9
    begins = rotation.t_ns == 0 or not 0.0 < dt <= tolerated_gap_s(adaptive.hold.interval_s)
    if plane.rank != 2:
        if begins:
            reset_rotation(rotation)  # too few beams to see a response: what is left is followed as ever
        return
    axis = to_world(pose, 0, 0.0, 0.0, 1.0)
    nx, ny, nz = rotate(-pose[3], -pose[4], -pose[5], pose[6], -plane.fitted_x, -plane.fitted_y, 1.0)
    if not nz > 0.0:
        return
    dx, dy = -nx / nz, -ny / nz  # slopes of the plane in the tool's frame
    mean, run = rotation.mean, rotation.run_mean
    rotation.t_ns = t_ns
    if begins:
        mean[0], mean[1] = dx, dy
        _begin_run(rotation, t_ns, axis)
        return
    share = slope_gain(dt)
    mean[0], mean[1] = mean[0] + share * (dx - mean[0]), mean[1] + share * (dy - mean[1])
    # beyond four standard deviations of the mean the deviation has changed
    band = 4.0 * assumed_noise_m(adaptive.noise) * math.sqrt(share / plane.spread_m2)
    in_run = rotation.phase == ROTATION_RUN
    _, turn = rotation_between(rotation.run_axis if in_run else rotation.test_axis, axis)
    # a test turns the tool back by `probe`; it stops at `permitted_turn_rad` from the test's direction
    least = MOTION_BANDS * band
    probe = least + params.permitted_turn_rad
    back = probe - turn  # by which the tool has turned back in a test
    # with one blocked beam of three the deviation grows by a third of the rotation
    answer = band if in_run else max(TEST_BAND_FACTOR * band, 0.5 * back)
    can_answer = in_run or back > 0.5 * least
    if can_answer and elementary.hypot(mean[0] - run[0], mean[1] - run[1]) > answer:
        _begin_run(rotation, t_ns, axis)
        return
    rotation.samples += 1 if can_answer else 0
    enough = rotation.samples * share > MIN_MEANS
    if in_run:
        if rotation.samples < RUN_SAMPLES:  # the mean of the run is the better known one
            part = 1.0 / rotation.samples
            run[0], run[1] = run[0] + part * (mean[0] - run[0]), run[1] + part * (mean[1] - run[1])
        rate = turn / max((t_ns - rotation.run_ns) * 1e-9, dt)
        deviation = elementary.hypot(run[0], run[1])
        wrong = is_suspicious(deviation, turn, rate, band, adaptive.plant.tau_s, params.max_tilt_rad)
        far = turn > 0.3 * params.max_tilt_rad  # beyond, a constant deviation is always tested
        if enough and turn > probe and (wrong or far):
            rotation.phase, rotation.samples, rotation.test_ns = ROTATION_TEST, 0, t_ns
            for i in range(3):
                rotation.test_axis[i] = axis[i] + probe / turn * (rotation.run_axis[i] - axis[i])
    elif rotation.phase == ROTATION_TEST:
        obeyed = params.run == RUN_NORMAL and adaptive.attitude.t_ns != 0 and adaptive.beams.inconsistent == 0
        if not obeyed:
            rotation.test_ns = t_ns  # no rotation is demanded, or none is applied
        longest_s = ANSWER_TAUS * adaptive.plant.tau_s + 2.0 * probe / params.max_turn_speed_radps
        late = (t_ns - rotation.test_ns) * 1e-9 > longest_s
        if enough or late:
            rotation.phase = ROTATION_FAILED


@jit
def tested_direction(rotation, normal):
    """Direction for the tool's axis: the unit normal, or that of the test, whose length is about 1."""
    if rotation.phase == ROTATION_RUN:
        return normal
    return rotation.test_axis[0], rotation.test_axis[1], rotation.test_axis[2]
