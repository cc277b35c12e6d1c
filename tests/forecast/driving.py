"""Drive kernel and twin with the same random stream."""

from __future__ import annotations

import numpy as np

from naive import NaiveFollower
from surffollow.config.params import PARAMS
from surffollow.forecast.step import follow_step, sf_reset
from surffollow.shm.conversion import pack_conversion
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_follow import STATUS_NAMES, FollowState, Inputs, Output, Params

MS = 1_000_000
SCALARS = tuple(n for n in PARAMS)


def default_params(**changes):
    """A (1,) `Params` record of a sensor with 12 bits over 2 to 6 inches, and the changes."""
    params = zeros(Params)
    p = params[0]
    for name, spec in PARAMS.items():
        p[name] = spec.default
    p["mode"] = 0  # paper, unless changed
    p["n_channels"] = 1
    p["scale_m"][:] = 0.1016 / 4095
    p["zero_m"][:] = 0.0508
    p["tool_from_sensor"].reshape(8, 7)[:, 6] = 1.0
    p["sensor_latency_ns"] = 0
    for name, value in changes.items():
        p[name] = value
    return params


def as_dict(params):
    """The same as the twin takes it: plain Python numbers and lists."""
    p = params[0]
    out = {n: p[n].item() for n in p.dtype.names if p[n].ndim == 0}
    out["scale_m"], out["zero_m"] = p["scale_m"].tolist(), p["zero_m"].tolist()
    out["tool_from_sensor"] = p["tool_from_sensor"].reshape(8, 7).tolist()
    return out


class Kernel:
    """The kernel with its memory."""

    def __init__(self, params):
        self.params, self.state = params, zeros(FollowState)
        self.inputs, self.output, self.scratch = zeros(Inputs), zeros(Output), np.zeros(7)

    def step(self, t_ns, poses=(), conversions=(), ranges=None, given_t_ns=0):
        """poses: (t_ns, pose); conversions: (dt_ns, channel, flags, counts); ranges: distances."""
        i = self.inputs[0]
        i["t_ns"] = t_ns
        i["n_poses"] = len(poses)
        for k, (t, pose) in enumerate(poses):
            i["pose_t_ns"][k] = t
            i["pose"][7 * k : 7 * k + 7] = pose
        i["n_conversions"] = len(conversions)
        for k, (dt_ns, c, flags, counts) in enumerate(conversions):
            i["conversion"][k] = pack_conversion(counts, c, flags, dt_ns)
        i["n_ranges"] = 0 if ranges is None else len(ranges)
        if ranges is not None:
            i["given_m"][: len(ranges)] = ranges
            i["given_t_ns"] = given_t_ns
        follow_step(self.params, self.state, self.inputs, self.output, self.scratch)
        return self.output[0]

    def reset(self, offset_m):
        sf_reset(self.params, self.state, offset_m)


def names_of(bits):
    return {n for k, n in enumerate(STATUS_NAMES) if int(bits) >> k & 1}


class Pair:
    """Kernel and twin side by side; every step compares all they say, bit for bit."""

    def __init__(self, params):
        self.kernel = Kernel(params)
        self.twin = NaiveFollower(as_dict(params))

    def change(self, **values):
        for name, value in values.items():
            self.kernel.params[0][name] = value
            self.twin.params[name] = value

    def reset(self, offset_m):
        self.kernel.reset(offset_m)
        self.twin.reset(offset_m)

    def step(self, t_ns, poses=(), conversions=(), ranges=None, given_t_ns=0):
        o = self.kernel.step(t_ns, poses, conversions, ranges, given_t_ns)
        for t, pose in poses:
            self.twin.pose(t, pose)
        want = self.twin.step(t_ns, conversions, ranges, given_t_ns)
        got = {
            "status": names_of(o["status"]),
            "dz": float(o["demand"][2]),
            "fresh": {c for c in range(8) if int(o["fresh"]) >> c & 1},
            "targets": {c: o["target_m"][3 * c : 3 * c + 3].tolist() for c in want["targets"]},
            "delta_h": float(o["delta_h_m"]),
            "error": float(o["error_m"]),
            "cycle": int(o["cycle"]),
            "slope": float(o["slope"]),
            "speed": float(o["speed_mps"]),
            "intervals": int(o["intervals"]),
            "range_m": [None if r != r else r for r in o["range_m"].tolist()],
        }
        assert got == want, f"t {t_ns} ns:\nkernel {got}\ntwin   {want}"
        assert not o["demand"][[0, 1, 3, 4, 5]].any()
        return got
