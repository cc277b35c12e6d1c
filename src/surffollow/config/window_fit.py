"""Which windows, stand-offs and fold-back thresholds fit each other: one rule for every follower.

    range_min_m <= too_close_m <= too_close_exit_m < range_max_m,   too_close_m < offset_m < range_max_m

A `too_close_m` of 0 switches the detection of fold-back off.
"""

from __future__ import annotations

from collections.abc import Mapping

from surffollow.errors import ConfigError

# thresholds of TOO_CLOSE beyond the near limit: shares of the window's width (2.15 and 2.3 in of 2 to 6 in),
# but no more than shares of the way to the stand-off, which those of a wide window would pass
CLOSE_OF_WINDOW, EXIT_OF_WINDOW = 0.0375, 0.075
CLOSE_OF_WAY, EXIT_OF_WAY = 0.1, 0.2
# the arguments of `misfit`
FITTED = ("range_min_m", "range_max_m", "offset_m", "too_close_m", "too_close_exit_m")
RULE = (
    "range_min_m <= too_close_m <= too_close_exit_m < range_max_m, and offset_m between too_close_m and "
    "range_max_m"
)
# results of `misfit`: the parameter at fault, and the text; {0} … {4} are the arguments
MISFITS = (
    (
        "range_min_m",
        "range_min_m {0:g} m is not below range_max_m {1:g} m; set both, or the window of driver or sensors",
    ),
    (
        "offset_m",
        "offset_m {2:g} m is outside the sensor's window {0:g} to {1:g} m; set another offset_m, "
        "or the window of driver or sensors",
    ),
    (
        "too_close_m",
        "too_close_m {3:g} m is above too_close_exit_m {4:g} m; set both too_close_m and too_close_exit_m",
    ),
    (
        "too_close_exit_m",
        "too_close_exit_m {4:g} m is not below range_max_m {1:g} m, so that no valid reading could end "
        "TOO_CLOSE; set a smaller too_close_exit_m",
    ),
    (
        "too_close_m",
        "too_close_m {3:g} m is not below offset_m {2:g} m, so that every reading at the stand-off would be "
        "too close; set a smaller too_close_m, or another offset_m",
    ),
    (
        "too_close_m",
        "too_close_m {3:g} m is below range_min_m {0:g} m, so that no valid reading could be too close; "
        "set too_close_m and too_close_exit_m too, or too_close_m to 0 for no detection of fold-back",
    ),
)


def default_too_close(near_m: float, far_m: float, offset_m: float) -> tuple[float, float]:
    """Thresholds of the fold-back that follow from window and stand-off.

    Parameters
    ----------
    near_m, far_m : float  limits of the sensor's window [m]
    offset_m : float       stand-off [m]

    Returns
    -------
    too_close_m, too_close_exit_m : float
    """
    width, way = max(far_m - near_m, 0.0), max(offset_m - near_m, 0.0)
    return (
        near_m + min(CLOSE_OF_WINDOW * width, CLOSE_OF_WAY * way),
        near_m + min(EXIT_OF_WINDOW * width, EXIT_OF_WAY * way),
    )


def misfit(near_m: float, far_m: float, offset_m: float, close_m: float, exit_m: float) -> int:
    """Whether window, stand-off and fold-back fit each other; the service compiles it.

    Parameters
    ----------
    near_m, far_m : float64      limits of the sensor's window [m]
    offset_m : float64           stand-off [m]
    close_m, exit_m : float64    where TOO_CLOSE begins and ends [m]

    Returns
    -------
    int64  -1 when they do, else an index of `MISFITS`
    """
    if not near_m < far_m:
        return 0
    if not near_m < offset_m < far_m:
        return 1
    if not close_m <= exit_m:
        return 2
    if not exit_m < far_m:
        return 3
    if not close_m < offset_m:
        return 4
    if 0.0 < close_m < near_m:
        return 5
    return -1


def check_fit(values: Mapping[str, float]) -> None:
    """Raise ConfigError when parameters, by full name, do not fit each other."""
    fitted = [float(values[name]) for name in FITTED]
    found = misfit(*fitted)
    if found >= 0:
        raise ConfigError(MISFITS[found][1].format(*fitted))
