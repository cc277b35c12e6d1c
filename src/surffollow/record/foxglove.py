"""Foxglove's message types that recordings use: names, field numbers and types as in its schemas."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.record.protobuf import Enum, Field, Message

TIMESTAMP = Message(
    "google.protobuf", "Timestamp", (Field("seconds", 1, "int64"), Field("nanos", 2, "int32"))
)


def _type(name: str, *fields: tuple[Any, ...], enums: tuple[Enum, ...] = ()) -> Message:
    return Message("foxglove", name, tuple(Field(f[0], k + 1, *f[1:]) for k, f in enumerate(fields)), enums)


_STAMP = ("timestamp", "message", False, TIMESTAMP)
VECTOR3 = _type("Vector3", *((n, "double") for n in "xyz"))
QUATERNION = _type("Quaternion", *((n, "double") for n in "xyzw"))
POSE = _type("Pose", ("position", "message", False, VECTOR3), ("orientation", "message", False, QUATERNION))
POSE_IN_FRAME = _type("PoseInFrame", _STAMP, ("frame_id", "string"), ("pose", "message", False, POSE))
FRAME_TRANSFORM = _type(
    "FrameTransform",
    _STAMP,
    ("parent_frame_id", "string"),
    ("child_frame_id", "string"),
    ("translation", "message", False, VECTOR3),
    ("rotation", "message", False, QUATERNION),
)
FRAME_TRANSFORMS = _type("FrameTransforms", ("transforms", "message", True, FRAME_TRANSFORM))
_NUMERIC = Enum(
    "NumericType",
    ("UNKNOWN", "UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "FLOAT32", "FLOAT64"),
)
ELEMENT = _type(
    "PackedElementField",
    ("name", "string"),
    ("offset", "fixed32"),
    ("type", "enum", False, _NUMERIC),
    enums=(_NUMERIC,),
)
POINT_CLOUD = _type(
    "PointCloud",
    _STAMP,
    ("frame_id", "string"),
    ("pose", "message", False, POSE),
    ("point_stride", "fixed32"),
    ("fields", "message", True, ELEMENT),
    ("data", "bytes"),
)
LASER_SCAN = _type(
    "LaserScan",
    _STAMP,
    ("frame_id", "string"),
    ("pose", "message", False, POSE),
    ("start_angle", "double"),
    ("end_angle", "double"),
    ("ranges", "double", True),
    ("intensities", "double", True),
)
_LEVEL = Enum("Level", ("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL"))
LOG = _type(
    "Log",
    _STAMP,
    ("level", "enum", False, _LEVEL),
    ("message", "string"),
    ("name", "string"),
    ("file", "string"),
    ("line", "fixed32"),
    enums=(_LEVEL,),
)
INFO, WARNING = _LEVEL.values.index("INFO"), _LEVEL.values.index("WARNING")
ALL = (FRAME_TRANSFORMS, POSE_IN_FRAME, POINT_CLOUD, LASER_SCAN, LOG)

_IDENTITY = {"position": {}, "orientation": {"w": 1.0}}
_FLOAT64, _UINT8 = (_NUMERIC.values.index(n) for n in ("FLOAT64", "UINT8"))


def stamp(wall_ns: int) -> dict[str, int]:
    """A `google.protobuf.Timestamp`."""
    return {"seconds": wall_ns // 1_000_000_000, "nanos": wall_ns % 1_000_000_000}


def vector(xyz: Sequence[float]) -> dict[str, float]:
    """A `Vector3`."""
    return {"x": xyz[0], "y": xyz[1], "z": xyz[2]}


def quaternion(q: Sequence[float]) -> dict[str, float]:
    """A `Quaternion` from qx qy qz qw."""
    return {"x": q[0], "y": q[1], "z": q[2], "w": q[3]}


def pose_in_frame(wall_ns: int, frame: str, pose: Sequence[float]) -> bytes:
    """A pose of seven numbers (x y z [m], qx qy qz qw) in a frame."""
    body = {"position": vector(pose), "orientation": quaternion(pose[3:])}
    return POSE_IN_FRAME.encode({"timestamp": stamp(wall_ns), "frame_id": frame, "pose": body})


def transform(wall_ns: int, parent: str, child: str, pose: Sequence[float]) -> dict[str, Any]:
    """One `FrameTransform`: the child's frame in the parent's.

    Parameters
    ----------
    wall_ns : int [ns]   CLOCK_REALTIME
    parent, child : str  names of the frames
    pose : 7 numbers     x y z [m], qx qy qz qw
    """
    return {
        "timestamp": stamp(wall_ns),
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": vector(pose),
        "rotation": quaternion(pose[3:]),
    }


def point_cloud(
    wall_ns: int, frame: str, points_m: NDArray[np.float64], counts: NDArray[np.uint8] | None = None
) -> bytes:
    """Points as float64: a workshop's coordinates may have six digits before the point.

    With `counts` each point has its number of samples.

    Parameters
    ----------
    wall_ns : int [ns]  CLOCK_REALTIME
    frame : str         name of the points' frame
    points_m : (n, 3) float64 [m]
    counts : (n,) uint8 or None
    """
    kinds: list[tuple[str, str]] = [("x", "<f8"), ("y", "<f8"), ("z", "<f8")]
    if counts is not None:
        kinds.append(("samples", "u1"))
    packed = np.zeros(len(points_m), np.dtype(kinds))
    for k, axis in enumerate("xyz"):
        packed[axis] = points_m[:, k]
    fields = [{"name": n, "offset": 8 * k, "type": _FLOAT64} for k, n in enumerate("xyz")]
    if counts is not None:
        packed["samples"] = counts
        fields.append({"name": "samples", "offset": 24, "type": _UINT8})
    return POINT_CLOUD.encode(
        {
            "timestamp": stamp(wall_ns),
            "frame_id": frame,
            "pose": _IDENTITY,
            "point_stride": packed.dtype.itemsize,
            "fields": fields,
            "data": packed.tobytes(),
        }
    )


def log_line(wall_ns: int, level: int, text: str) -> bytes:
    """A line of the log."""
    return LOG.encode({"timestamp": stamp(wall_ns), "level": level, "message": text, "name": "surffollow"})
