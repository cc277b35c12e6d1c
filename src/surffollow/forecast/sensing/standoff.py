"""Point of the ground under the tool, and the desired height of the tool above it."""

from surffollow.forecast.modes import orients
from surffollow.forecast.pose import newest_pose, to_world
from surffollow.shm.jit import jit_inlined


@jit_inlined
def axis_ground_point(params, pose, at):
    """Point of the tool's axis that should touch the ground, from the tool, in world axes [m].

    The axis is that of the tool's frame which is nearest to channel 0's beam.

    Parameters
    ----------
    params : record of `Params`
    pose : (≥ at + 7,) float64  x y z [m], qx qy qz qw
    at : int                    index of the first number
    """
    m = params.tool_from_sensor
    x, y, z = to_world(m, 0, 0.0, 0.0, -params.offset_m)
    along_z = abs(z) >= abs(x) and abs(z) >= abs(y)
    along_x = not along_z and abs(x) >= abs(y)
    x = m[0] + x if along_x else 0.0
    y = 0.0 if along_x or along_z else m[1] + y
    z = m[2] + z if along_z else 0.0
    return to_world(pose, at, x, y, z)


@jit_inlined
def standoff_height(params, plane, sense):
    """Desired height of the tool, in the newest pose reported, above the ground point on its axis [m].

    Parameters
    ----------
    params, plane, sense : records of `Params`, `Plane`, `SenseState`
    """
    pose, at = sense.pose, 7 * newest_pose(sense)
    if not orients(params):
        _, _, tip_z = axis_ground_point(params, pose, at)
        return -tip_z
    tx, ty, tz = to_world(pose, at, 0.0, 0.0, 1.0)
    along = tz - plane.slope_x * tx - plane.slope_y * ty  # (tool axis · normal) over the normal's z
    return (params.offset_m - params.tool_from_sensor[2]) * along
