"""Preview control of the axis over known ground: bounded least squares.

    min  ½ Σ w (z − g)² + ½ λ Σ a²   subject to |a| ≤ a_max

z is the axis, g the desired height, a the second difference of z; position and velocity v of the axis are
given: before now lies the point z_1 - 2vT, so that v is the velocity now and not that of half a period ago.
It is solved by the alternating direction method of multipliers (ADMM): one pentadiagonal factorisation and
a clip, a fixed number of times, warm-started from the last period. Extrapolated ground beyond the known piece
has half the weight, so that the axis does not arrive there too fast; ground farther on has almost none.

The axis must be able to stop above the lowest ground known until then: the plan of least squares alone would
begin to descend long before an edge.
"""

from surffollow.forecast.plant.axis_model import PERIOD_S, invert_axis
from surffollow.forecast.plant.controller_clock import usual_periods
from surffollow.forecast.terrain.known_ground import MAX_UNCONFIRMED_DESCENT_M
from surffollow.forecast.terrain.terrain_buffer import CELL_M
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import HORIZON

ACCELERATION_SHARE = 0.9  # of the axis' acceleration; the rest is for corrections


@jit
def point_weight(k, known_periods):
    """Weight of point k of the plan, which is k + 1 periods from now.

    Ground is extrapolated over 16 periods. Beyond, the weight is not 0, so that the matrix stays regular.
    """
    if k + 1 < known_periods:
        return 1.0
    return 0.5 if k + 1 < known_periods + 16 else 1e-6


@jit
def factorise(plan, known_periods, stiffness):
    """LDLᵀ of W + stiffness·DᵀD, for second differences D with known position and velocity at the begin."""
    for k in range(HORIZON):
        # row k of DᵀD: differences b_k (centre k-1; b_0 is twice the first point), b_{k+1}, b_{k+2}
        d = (4.0 if k == 0 else 1.0) + (4.0 if k + 1 < HORIZON else 0.0) + (1.0 if k + 2 < HORIZON else 0.0)
        e = (-2.0 if k + 1 < HORIZON else 0.0) + (-2.0 if k + 2 < HORIZON else 0.0)
        f = 1.0 if k + 2 < HORIZON else 0.0
        d, e, f = point_weight(k, known_periods) + stiffness * d, stiffness * e, stiffness * f
        if k >= 1:
            d -= plan.factor_1[k - 1] ** 2 * plan.factor_0[k - 1]
            e -= plan.factor_1[k - 1] * plan.factor_2[k - 1] * plan.factor_0[k - 1]
        if k >= 2:
            d -= plan.factor_2[k - 2] ** 2 * plan.factor_0[k - 2]
        plan.factor_0[k] = d
        plan.factor_1[k] = e / d
        plan.factor_2[k] = f / d


@jit
def solve(plan):
    """Solve with those factors, in place, for `plan.position_m`."""
    n, z = HORIZON, plan.position_m
    for k in range(n):
        if k >= 1:
            z[k] -= plan.factor_1[k - 1] * z[k - 1]
        if k >= 2:
            z[k] -= plan.factor_2[k - 2] * z[k - 2]
    for k in range(n - 1, -1, -1):
        z[k] /= plan.factor_0[k]
        if k + 1 < n:
            z[k] -= plan.factor_1[k] * z[k + 1]
        if k + 2 < n:
            z[k] -= plan.factor_2[k] * z[k + 2]


@jit
def solve_plan(params, adaptive, known_periods, z_m, v_mps, standoff_m):
    """Solve the plan: positions relative to now in `plan.position_m`.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState`; `preview.ground_m` holds the ground from now on
    known_periods, z_m, standoff_m : as in `plan_setpoint`
    v_mps : float64  velocity of the axis now, with the disturbance [m/s]
    """
    n, plan, ground_m = HORIZON, adaptive.plan, adaptive.preview.ground_m
    limit = ACCELERATION_SHARE * params.plant_a_max_mps2 * PERIOD_S * PERIOD_S
    penalty = 60.0  # of ADMM
    stiffness = params.plan_effort_s4 / PERIOD_S**4 + penalty
    factorise(plan, known_periods, stiffness)
    begin = 2.0 * v_mps * PERIOD_S  # b_0 = 2 z_0 - 2 v T, relative to now
    for k in range(n - 1):
        plan.acceleration_m[k] = plan.acceleration_m[k + 1]
        plan.multiplier_m[k] = plan.multiplier_m[k + 1]
    plan.acceleration_m[n - 1] = plan.multiplier_m[n - 1] = 0.0
    for _ in range(25):  # convergence with a warm start is compared with a general solver in the tests
        for k in range(n):
            # point k is k + 1 periods from now
            desired_m = ground_m[min(k + 1, n - 1)] + standoff_m - z_m
            plan.position_m[k] = point_weight(k, known_periods) * desired_m
            # difference k spans points k-2, k-1 and k; the point before point 0 is now, at 0
            r = penalty * (plan.acceleration_m[k] - plan.multiplier_m[k])
            plan.position_m[k] += 2.0 * (r + stiffness * begin) if k == 0 else r
            if k >= 1:
                plan.position_m[k - 1] -= 2.0 * r
            if k >= 2:
                plan.position_m[k - 2] += r
        solve(plan)
        z2, z1 = plan.position_m[0] - begin, 0.0
        for k in range(n):
            b = plan.position_m[k] - 2.0 * z1 + z2
            z2, z1 = z1, plan.position_m[k]
            u = min(max(b + plan.multiplier_m[k], -limit), limit)
            plan.multiplier_m[k] += b - u
            plan.acceleration_m[k] = u
    # the clipped accelerations are feasible, the points approximately
    z1, v = 0.0, v_mps * PERIOD_S
    for k in range(n):
        v += plan.acceleration_m[k] * (0.5 if k == 0 else 1.0)
        z1 += v
        plan.position_m[k] = z1


@jit
def planned_position(plan, periods):
    """Position of the plan so many periods from now, relative to now, linear between its points [m]."""
    k = int(periods)
    before = plan.position_m[k - 1] if k > 0 else 0.0
    return before + (periods - k) * (plan.position_m[k] - before)


@jit
def least_speed(params, adaptive, known_periods, z_m, standoff_m, held_periods):
    """Velocity from which the axis can stop above the lowest ground known until then, ≤ 0 [m/s].

    Parameters
    ----------
    params, adaptive, known_periods, z_m, standoff_m : as in `plan_setpoint`
    held_periods : float64  until the next setpoint
    """
    ground_m, brake_mps2 = adaptive.preview.ground_m, ACCELERATION_SHARE * params.plant_a_max_mps2
    late = int(CELL_M / max(adaptive.kinematics.speed_mps * PERIOD_S, CELL_M / HORIZON))
    lowest, least = ground_m[0], -params.plant_v_max_mps
    # where the sensor under the tool confirms the ground second passes over boxes gain 11 % by 4 mm
    early_m = MAX_UNCONFIRMED_DESCENT_M if adaptive.preview.sensed_periods > 0 else 4e-3
    for k in range(1, known_periods):
        lowest = min(lowest, ground_m[max(k - late, 0)])  # the place of an edge is known to a cell
        room = max(z_m - lowest - standoff_m + early_m, 0.0)
        braking_s = max(k - held_periods, 0.0) * PERIOD_S  # it brakes from the next setpoint on
        least = max(least, -(room + 0.5 * brake_mps2 * braking_s * braking_s) / (k * PERIOD_S))
    return least


@jit
def return_to_ground(plan, ground_m, known_periods, z_m, speed_mps, standoff_m):
    """Limit the setpoint of a tool that has left the known ground on one side, and does not return.

    The plan changes the velocity of the tool by what its axis can do in a period. Where wind moves it faster,
    the velocity that is asked for would follow that of the wind.

    Parameters
    ----------
    plan : record of `Plan`   `setpoint_m` updated
    ground_m : float64 array  the ground from now on [m]
    known_periods, z_m, standoff_m : as in `plan_setpoint`
    speed_mps : float64       velocity of the tool at the latch time [m/s]
    """
    lowest_m, highest_m = ground_m[:known_periods].min(), ground_m[:known_periods].max()
    if z_m < lowest_m + standoff_m and speed_mps <= 0.0:
        plan.setpoint_m = max(plan.setpoint_m, lowest_m + standoff_m)
    if z_m > highest_m + standoff_m and speed_mps >= 0.0:
        plan.setpoint_m = min(plan.setpoint_m, highest_m + standoff_m)


@jit
def plan_setpoint(params, adaptive, known_periods, z_m, v_mps, standoff_m):
    """Solve the plan and invert the axis model: setpoint of the coming period.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`plan` updated)
    known_periods : int   periods of `preview.ground_m` that are known
    z_m, v_mps : float64  axis at the latch time [m, m/s], its velocity without the disturbance
    standoff_m : float64  desired height of the tool above the ground [m]
    """
    plan, held_periods = adaptive.plan, usual_periods(adaptive.controller)
    disturbance_mps = adaptive.plant.disturbance_mps
    solve_plan(params, adaptive, known_periods, z_m, v_mps + disturbance_mps, standoff_m)
    held_m, next_m = planned_position(plan, held_periods), planned_position(plan, held_periods + 1.0)
    straight_m = held_m + 0.5 * (next_m - planned_position(plan, held_periods - 1.0))
    # one period behind a setpoint the axis is between the place to which its velocity then leads it (alone it
    # is late at edges) and the plan (alone it is early: second passes 1.03 times the error)
    desired_m = straight_m + 0.5 * (next_m - straight_m)
    least_mps = least_speed(params, adaptive, known_periods, z_m, standoff_m, held_periods)
    held_s, ahead_s = held_periods * PERIOD_S, (held_periods + 1.0) * PERIOD_S
    desired_m = z_m + max(desired_m, ahead_s * least_mps) - ahead_s * disturbance_mps
    plan.setpoint_m = invert_axis(params, adaptive.plant.tau_s, z_m, v_mps, desired_m, held_s)
    return_to_ground(plan, adaptive.preview.ground_m, known_periods, z_m, v_mps + disturbance_mps, standoff_m)
