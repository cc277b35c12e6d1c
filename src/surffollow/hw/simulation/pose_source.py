"""Poses of the simulated sensors: from the simulated robot's block, or from reports."""

from __future__ import annotations

from typing import Any

import numpy as np

from surffollow.hw.driver import REPORT_WORDS, PoseQueue
from surffollow.hw.driver_thread import CATCH_UP_NS, PERIOD_NS, STOP, USER
from surffollow.hw.simulation import adc
from surffollow.hw.simulation.pose_history import add_pose, add_report
from surffollow.hw.simulation.sensor_rig import produce
from surffollow.shm import atomics as at
from surffollow.shm.clock import now_ns, wait_until_ns
from surffollow.shm.dtypes import zeros
from surffollow.shm.jit import jit
from surffollow.shm.latch import latch_read
from surffollow.shm.ring import ring_drop, ring_peek
from surffollow.shm.schema import F64, I64, Schema
from surffollow.shm.world_block import WorldPose

REQUESTED, IN_USE, POSE_T, SOURCE = USER, USER + 1, USER + 2, USER + 3  # control words
FROM_NOTHING, FROM_WORLD, FROM_REPORTS = 0, 1, 2  # SOURCE: origin of the poses

WORLD_BYTES = WorldPose.SIZE
STALE_WORLD_NS = 100_000_000


class PoseSource(Schema):
    """State for taking poses from one source or the other."""

    source = I64(doc="FROM_…, of the history")
    reports = I64(doc="address of the queue of reported poses")
    capacity = I64()
    item = I64(REPORT_WORDS, doc="scratch")
    item_address = I64()
    pose = F64(7, unit="m, 1", doc="scratch")
    velocity = F64(6, unit="m/s, rad/s", doc="scratch")


def make_pose_source(reports: PoseQueue) -> np.ndarray[Any, Any]:
    """`PoseSource` record, shape (1,), over a queue of reported poses."""
    poses = zeros(PoseSource)
    poses["reports"], poses["capacity"] = reports.address, reports.capacity
    poses["item_address"] = poses.ctypes.data + PoseSource.offset("item")
    return poses


@jit
def read_reports(control: Any, poses: Any, history: Any) -> None:
    """Empty the queue of reported poses; they enter the history when they are the source of the poses.

    Parameters
    ----------
    control : int64, address of the thread's control words
    poses : (1,) `PoseSource`
    history : (1,) `PoseHistory`
    """
    r = poses[0]
    while ring_peek(r.reports, r.capacity, REPORT_WORDS, r.item_address) == 1:
        ring_drop(r.reports, 1)
        if r.source != FROM_REPORTS:
            continue
        for k in range(7):
            r.pose[k] = at.load_relaxed_f64(r.item_address + 8 * (1 + k))
        t_ns = at.load_relaxed_i64(r.item_address)
        if add_report(history, t_ns, r.pose, r.velocity) == 1:
            at.store_relaxed_i64(control + 8 * POSE_T, t_ns)


@jit
def run_rig(
    control: Any, rig: Any, led: Any, history: Any, z: Any, frame: Any, world: Any, poses: Any
) -> None:
    """Follow a source of poses and the clock until `STOP`.

    Parameters
    ----------
    control : int64, address of the thread's control words
    rig, led, history, z, frame : see `produce`
    world : (1,) `WorldPose`, scratch
    poses : (1,) `PoseSource`
    """
    generation = 0
    wake = now_ns()
    while at.load_acquire_i64(control + 8 * STOP) == 0:
        latch = at.load_acquire_i64(control + 8 * REQUESTED)
        if latch != at.load_relaxed_i64(control + 8 * IN_USE):
            at.store_release_i64(control + 8 * IN_USE, latch)
            generation = 0
        source = at.load_acquire_i64(control + 8 * SOURCE)
        if source != poses[0].source:
            poses[0].source = source
            at.store_relaxed_i64(control + 8 * POSE_T, 0)
            history[0].count = 0  # two sources are never interpolated across
            generation = 0
        read_reports(control, poses, history)
        now = now_ns()
        if source == FROM_WORLD and latch != 0 and at.load_acquire_i64(latch) != generation:
            found = latch_read(latch, np.int64(world.ctypes.data), WORLD_BYTES)
            t_ns = world[0].t_ns
            if found > 0 and t_ns <= now + STALE_WORLD_NS:
                generation = found
                history[0].carry_ns = 0
                add_pose(history, t_ns, world[0].pose, world[0].velocity)
                at.store_relaxed_i64(control + 8 * POSE_T, t_ns)
        first = adc.first_number_from(now - CATCH_UP_NS)
        missed = first - rig[0].next_number
        if missed > 0:
            at.store_relaxed_i64(rig[0].lost, at.load_relaxed_i64(rig[0].lost) + missed)
            rig[0].next_number = first
        produce(rig, led, history, z, frame, now)
        wake = max(wake + PERIOD_NS, now)
        wait_until_ns(wake, 0)
