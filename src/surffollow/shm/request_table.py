"""Arguments and answers of every request, for clients that are written from the layout's JSON.

The service reads only the words that stand here; all others of a request are ignored.
"""

from __future__ import annotations

from dataclasses import dataclass

from surffollow.shm import layout_board as lb
from surffollow.shm import layout_slot as ls


@dataclass(frozen=True)
class Argument:
    """Words `array[first]` to `array[first + count - 1]` of a request; count 0: as many as `n` says."""

    array: str  # "number" (int64) or "value" (float64)
    first: int
    count: int
    name: str
    unit: str = ""
    doc: str = ""


@dataclass(frozen=True)
class Request:
    """A request: its arguments, and the meaning of `detail` in each of its answers.

    Attributes
    ----------
    code : int               RQ_…
    answers : dict           result → meaning of `detail`; in the part `acks`
    end : dict               the same for the answer that follows ACCEPTED in `map_acks`; empty: none does
    n : str                  what the word `n` must be; "": it is ignored
    """

    code: int
    doc: str
    may: str
    arguments: tuple[Argument, ...]
    answers: dict[int, str]
    end: dict[int, str]
    n: str = ""


_NUMBER = "number of the parameter at fault"
_HOLDER = "pid of the client that sends the pose; 0: none"
_ANYBODY = "any client"
_CHANNEL = Argument("number", 0, 1, "channel", doc="of the external driver")
_CHANNELS = "channels that the driver has; 0: it takes no pushed ranges"
_SETTER = (
    "as access.parameters says: by default the pose's holder, and any client while no client sends the pose"
)
_REGION = (
    Argument("value", 0, 1, "x_min", "m"),
    Argument("value", 1, 1, "y_min", "m"),
    Argument("value", 2, 1, "x_max", "m"),
    Argument("value", 3, 1, "y_max", "m"),
)
_MAPPER = "as access.map says: by default the pose's holder, and any client while no client sends the pose"
_MAP_ANSWERS = {
    lb.ERR_NOT_POSE_HOLDER: _HOLDER,
    lb.ACCEPTED: "0",
    lb.ERR_BAD_REGION: "0",
    lb.ERR_MAP_BUSY: "0",
    lb.ERR_QUEUE_FULL: "0",
}
_MAP_END = {
    lb.OK: "0",
    lb.ERR_BAD_REGION: "0",
    lb.ERR_MAP_BUSY: "0",
    lb.ERR_MAP_TOO_LARGE: "0",
}

REQUESTS: tuple[Request, ...] = (
    Request(
        lb.RQ_SF_RESET,
        "restart the forecast with a desired stand-off (paper: SFReset)",
        _SETTER,
        (Argument("value", 0, 1, "offset_m", "m", "the stand-off, in the window, beyond too_close_m"),),
        {
            lb.OK: "0",
            lb.ERR_BAD_VALUE: _NUMBER,
            lb.ERR_BEYOND_LIMITS: _NUMBER,
            lb.ERR_NOT_POSE_HOLDER: _HOLDER,
        },
        {},
    ),
    Request(
        lb.RQ_SET_PARAMS,
        "set parameters, all or none",
        _SETTER,
        (
            Argument("number", 0, 0, "parameter", doc="number of a parameter, each at most once"),
            Argument(
                "value", 0, 0, "value", doc="its value in the parameter's unit, whole where the parameter is"
            ),
        ),
        {
            lb.OK: "0",
            lb.ERR_BAD_VALUE: _NUMBER + "; -1: n",
            lb.ERR_BEYOND_LIMITS: _NUMBER,
            lb.ERR_NOT_POSE_HOLDER: _HOLDER,
        },
        {},
        n=f"parameters in the request, 1 to {ls.REQUEST_ARGS}",
    ),
    Request(
        lb.RQ_CLAIM_POSE,
        "become the one client that sends the pose; poses posted before do not count",
        _ANYBODY,
        (),
        {lb.OK: "0", lb.ERR_POSE_HELD: _HOLDER},
        {},
    ),
    Request(
        lb.RQ_RELEASE_POSE,
        "let another client send the pose",
        "the pose's holder",
        (),
        {lb.OK: "0", lb.ERR_NOT_HOLDER: "0"},
        {},
    ),
    Request(
        lb.RQ_MAP_RESET,
        "clear the map and lay it over a region (paper: MapReset)",
        _MAPPER,
        _REGION,
        _MAP_ANSWERS,
        _MAP_END,
    ),
    Request(
        lb.RQ_MAP_REFOCUS,
        "lay the map over another region, keeping known heights (paper: MapRefocus)",
        _MAPPER,
        (
            *_REGION,
            Argument(
                "value",
                4,
                1,
                "finest_grid_m",
                "m",
                "finest useful grid of this refocus, 1e-6 to 1e4; 0: the configuration's (map.finest_grid)",
            ),
        ),
        _MAP_ANSWERS,
        {**_MAP_END, lb.ERR_NO_MAP: "0", lb.ERR_BAD_VALUE: "-1", lb.ERR_CANCELLED: "0"},
    ),
    Request(
        lb.RQ_MAP_INSTALL,
        "replace the map by one that is streamed through the slot's last part",
        _MAPPER,
        (
            *_REGION,
            Argument("value", 4, 1, "grid_m", "m", "side of a grid"),
            Argument("value", 5, 1, "x0_m", "m", "outer corner of grid (0, 0)"),
            Argument("value", 6, 1, "y0_m", "m", "outer corner of grid (0, 0)"),
            Argument("value", 7, 1, "datum_m", "m", "height of quantum 0"),
            Argument("value", 8, 1, "quantum_m", "m", "height of one count"),
            Argument("number", 0, 1, "nx", doc="columns"),
            Argument("number", 1, 1, "ny", doc="rows"),
            Argument("number", 2, 1, "datum_set", doc="0: the next sample sets the datum"),
        ),
        _MAP_ANSWERS,
        {
            **_MAP_END,
            lb.ERR_BAD_VALUE: "-1",
            lb.ERR_CANCELLED: "0",
            lb.ACCEPTED: "grids taken so far, no end yet; 0: the installation's turn has come",
        },
    ),
    Request(
        lb.RQ_STOP,
        "latch the stop",
        _ANYBODY,
        (
            Argument(
                "number",
                0,
                ls.STOP_TEXT_WORDS,
                "reason",
                doc="UTF-8 in the bytes of these words, filled up with NUL",
            ),
        ),
        {lb.OK: "causes latched now, bits"},
        {},
    ),
    Request(
        lb.RQ_STOP_RESET,
        "leave the latched stop; the forecast restarts",
        "the pose's holder",
        (),
        {lb.OK: "0", lb.ERR_NOT_POSE_HOLDER: _HOLDER, lb.ERR_STOP_REMAINS: "causes still there, bits"},
        {},
    ),
    Request(
        lb.RQ_CLAIM_RANGE,
        "become the one client that pushes a channel's ranges; what it pushed before does not count",
        "as access.ranges says: by default clients of root and of the service's own user",
        (_CHANNEL,),
        {
            lb.OK: "0",
            lb.ERR_RANGE_HELD: "pid of the client that pushes them",
            lb.ERR_NO_CHANNEL: _CHANNELS,
            lb.ERR_NOT_ALLOWED: "0",
        },
        {},
    ),
    Request(
        lb.RQ_RELEASE_RANGE,
        "let another client push a channel's ranges",
        "the channel's holder",
        (_CHANNEL,),
        {lb.OK: "0", lb.ERR_NOT_HOLDER: "0", lb.ERR_NO_CHANNEL: _CHANNELS},
        {},
    ),
)
