"""The standard channels of a recording: samples and events as messages that Foxglove and Rerun show.

============== ======================== ==============================================================
topic          type                     when
============== ======================== ==============================================================
/tf            foxglove.FrameTransforms every sample: tool in world; each second also sensors on the tool
/pose          foxglove.PoseInFrame     every sample: the pose that the demand adds to
/setpoint      foxglove.PoseInFrame     every sample with a valid demand: that pose with the demand added
/beam/C        foxglove.LaserScan       every sample with a distance on channel C, in the sensor's frame
/points        foxglove.PointCloud      every sample: the target points found since the last one
/map           foxglove.PointCloud      all known grids, when they changed, at a bounded rate
/log           foxglove.Log             changes of status, health, faults; resets, stops, map commands, losses
/state         surffollow.Output        every sample: all that the cycle published
/params        surffollow.Params        at the beginning and when they changed
/service       surffollow.Service       once a second, live recordings only: counters and histograms
============== ======================== ==============================================================
"""

from __future__ import annotations

import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from surffollow.config.stop_causes import stop_names
from surffollow.record import foxglove as fx
from surffollow.record.protobuf import Field, Message
from surffollow.record.protobuf_types import message_of
from surffollow.record.samples import Event, Run
from surffollow.shm.layout_adaptive import FAULT_NAMES, HEALTH_NAMES
from surffollow.shm.layout_board import RQ_MAP_INSTALL, RQ_MAP_REFOCUS, RQ_MAP_RESET
from surffollow.shm.layout_follow import CHANNELS, MODE_ADAPTIVE, STATUS_NAMES, VALID, Output, Params
from surffollow.shm.schema import Schema
from surffollow.units import numbers_text

PACKAGE = "surffollow"
WORLD, TOOL = "world", "tool"
_STAMP = (Field("timestamp", 1, "message", of=fx.TIMESTAMP),)
OUTPUT = message_of(Output, PACKAGE, (*_STAMP, Field("health_name", 2, "string")))
PARAMS = message_of(Params, PACKAGE, _STAMP)
STATIC_NS = 1_000_000_000  # mounts are repeated so often, for readers that begin in the middle
# a beam leaves along the sensor's -z; a scan's zero is along x
_BEAM = {"position": {}, "orientation": {"y": math.sqrt(0.5), "w": math.sqrt(0.5)}}
_NO_POINTS = np.zeros((0, 3))
_PER_CHANNEL = {"range_m": 1, "range_t_ns": 1, "target_m": 3}
_MAP_COMMANDS = {RQ_MAP_RESET: "MapReset", RQ_MAP_REFOCUS: "MapRefocus", RQ_MAP_INSTALL: "map_install"}


class Sink(Protocol):
    """Destination of messages."""

    def add_message(self, topic: str, kind: Message, t_ns: int, data: bytes) -> None:
        """Append one message, `t_ns` of CLOCK_MONOTONIC.

        Parameters
        ----------
        topic : str
        kind : Message  type of the message
        t_ns : int [ns]
        data : bytes    encoded message
        """

    @property
    def wall_offset_ns(self) -> int:
        """CLOCK_REALTIME less CLOCK_MONOTONIC."""


def plain(schema: type[Schema], record: Any, per_channel: int | None = None) -> dict[str, Any]:
    """A record's fields as Python values; arrays over channels cut to those in use."""
    out: dict[str, Any] = {}
    for f in schema.FIELDS:
        value = record[f.name]
        if f.count > 1:
            n = f.count
            if per_channel is not None and f.name in _PER_CHANNEL:
                n = per_channel * _PER_CHANNEL[f.name]
            out[f.name] = value[:n].tolist()
        else:
            out[f.name] = value.item()
    return out


class StandardChannels:
    """Writes runs and events of one recording as messages.

    Parameters
    ----------
    sink : where they go
    params : (1,) record of `Params`     the sampler's own: those in force
    """

    def __init__(self, sink: Sink, params: NDArray[Any]) -> None:
        self.sink, self.params = sink, params
        self._static_ns = 0
        self._left = _NO_POINTS
        self._health: tuple[int, int, int] | None = None

    def take(self, part: Run | Event) -> None:
        """Write what a sampler gave."""
        if isinstance(part, Event):
            self._event(part)
            return
        begin = 0
        for row in part.rows:
            end = int(row["points"])
            points, self._left = np.concatenate([self._left, part.points_m[begin:end]]), _NO_POINTS
            self._sample(row, points)
            begin = end
        # they belong to the next sample
        self._left = np.concatenate([self._left, part.points_m[begin:]])

    def _wall(self, t_ns: int) -> int:
        return t_ns + self.sink.wall_offset_ns

    def _event(self, event: Event) -> None:
        t_ns = event.t_ns
        if event.kind == "params":
            self.announce(t_ns, "parameters changed")
        elif event.kind == "snapshot" and event.code:
            self.announce(t_ns, "a segment begins")
        elif event.kind == "reset":
            self.log(t_ns, f"SFReset: stand-off {event.values[0]:.6g} m")
        elif event.kind == "stop" and event.code:
            self.log(t_ns, f"stop latched: {', '.join(stop_names(event.code))}", fx.WARNING)
        elif event.kind == "stop":
            self.log(t_ns, "stop reset by the pose's holder")
        elif event.kind == "map":
            name = _MAP_COMMANDS.get(event.code, f"map command {event.code}")
            self.log(t_ns, f"{name} over {numbers_text(*event.values)} m")

    def announce(self, t_ns: int, why: str) -> None:
        """Write the parameters in force; mounts and status follow with the next sample."""
        self._static_ns, self._health = 0, None
        values = {"timestamp": fx.stamp(self._wall(t_ns)), **plain(Params, self.params[0])}
        self.sink.add_message("/params", PARAMS, t_ns, PARAMS.encode(values))
        self.log(t_ns, why)

    def log(self, t_ns: int, text: str, level: int = fx.INFO) -> None:
        """Write a line into /log."""
        self.sink.add_message("/log", fx.LOG, t_ns, fx.log_line(self._wall(t_ns), level, text))

    def _sample(self, row: Any, points_m: NDArray[np.float64]) -> None:
        o, sink = row["output"], self.sink
        t_ns, pose_t_ns, n = int(o["t_ns"]), int(o["pose_t_ns"]), int(self.params[0]["n_channels"])
        wall = self._wall(t_ns)
        values = plain(Output, o, n)
        code = int(o["health"])
        adaptive = int(self.params[0]["mode"]) == MODE_ADAPTIVE
        name = HEALTH_NAMES[code] if adaptive and 0 <= code < len(HEALTH_NAMES) else ""
        message = {"timestamp": fx.stamp(wall), "health_name": name, **values}
        sink.add_message("/state", OUTPUT, t_ns, OUTPUT.encode(message))
        self._transforms(t_ns, pose_t_ns, row["pose"].tolist(), n)
        if pose_t_ns:
            pose = row["pose"].tolist()
            data = fx.pose_in_frame(self._wall(pose_t_ns), WORLD, pose)
            sink.add_message("/pose", fx.POSE_IN_FRAME, t_ns, data)
            if values["status"] & VALID:
                moved = add_demand(pose, values["demand"])
                sink.add_message("/setpoint", fx.POSE_IN_FRAME, t_ns, fx.pose_in_frame(wall, WORLD, moved))
        for c, range_m in enumerate(values["range_m"]):
            if range_m == range_m:
                scan = {
                    "timestamp": fx.stamp(self._wall(values["range_t_ns"][c])),
                    "frame_id": f"sensor{c}",
                    "pose": _BEAM,
                    "ranges": [range_m],
                }
                sink.add_message(f"/beam/{c}", fx.LASER_SCAN, t_ns, fx.LASER_SCAN.encode(scan))
        if len(points_m):
            self._points(t_ns, points_m)
        self._watch(t_ns, values, code if adaptive else 0)

    def _transforms(self, t_ns: int, pose_t_ns: int, pose: list[float], n: int) -> None:
        transforms = []
        if pose_t_ns:
            transforms.append(fx.transform(self._wall(pose_t_ns), WORLD, TOOL, pose))
        if t_ns - self._static_ns >= STATIC_NS:
            self._static_ns = t_ns
            mounts = self.params[0]["tool_from_sensor"].reshape(CHANNELS, 7)[:n].tolist()
            transforms += [
                fx.transform(self._wall(t_ns), TOOL, f"sensor{c}", mount) for c, mount in enumerate(mounts)
            ]
        if transforms:
            data = fx.FRAME_TRANSFORMS.encode({"transforms": transforms})
            self.sink.add_message("/tf", fx.FRAME_TRANSFORMS, t_ns, data)

    def _points(self, t_ns: int, points_m: NDArray[np.float64]) -> None:
        data = fx.point_cloud(self._wall(t_ns), WORLD, points_m)
        self.sink.add_message("/points", fx.POINT_CLOUD, t_ns, data)

    def map_points(self, t_ns: int, points_m: NDArray[np.float64], counts: NDArray[np.uint8]) -> int:
        """Write all known grids of the map; the bytes written."""
        data = fx.point_cloud(self._wall(t_ns), WORLD, points_m, counts)
        self.sink.add_message("/map", fx.POINT_CLOUD, t_ns, data)
        return len(data)

    def _watch(self, t_ns: int, values: dict[str, Any], health: int) -> None:
        """Write a line when status, health or faults are others than at the sample before."""
        now = (values["status"], health, values["faults"])
        before, self._health = self._health, now
        if before == now:
            return
        names = [n for k, n in enumerate(STATUS_NAMES) if now[0] >> k & 1]
        text = "status " + (" ".join(names) or "none")
        if health or (before is not None and before[1]):
            text += f"; health {HEALTH_NAMES[health] if health < len(HEALTH_NAMES) else health}"
        faults = [n for k, n in enumerate(FAULT_NAMES) if now[2] >> k & 1]
        if faults:
            text += "; faults " + " ".join(faults)
        fine = bool(now[0] & VALID) and health == 0
        self.log(t_ns, text, fx.INFO if fine else fx.WARNING)


def add_demand(pose: list[float], demand: list[float]) -> list[float]:
    """The pose with a demand added: x y z, and the rotation vector turned after it in the world frame."""
    rotation = demand[3:]
    angle = math.sqrt(sum(v * v for v in rotation))
    q = list(pose[3:])
    if angle > 0.0:
        s = math.sin(angle / 2) / angle
        x, y, z, w = rotation[0] * s, rotation[1] * s, rotation[2] * s, math.cos(angle / 2)
        a, b, c, d = q
        q = [
            w * a + x * d + y * c - z * b,
            w * b - x * c + y * d + z * a,
            w * c + x * b - y * a + z * d,
            w * d - x * a - y * b - z * c,
        ]
    return [p + v for p, v in zip(pose[:3], demand[:3])] + q
