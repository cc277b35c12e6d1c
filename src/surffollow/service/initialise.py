"""Initialise a service's memory and constants (paper §3.3.1)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.config.limits import CHANGED_BY, check_within_limits, client_limits, range_user
from surffollow.config.params import PARAMS
from surffollow.config.service import ServiceConfig, follow_params, map_quantum_m, seconds
from surffollow.config.stop_causes import STOP_NAMES, stop_causes
from surffollow.config.trusted_users import own_user
from surffollow.config.window_fit import FITTED, check_fit, default_too_close
from surffollow.forecast.reference_scales import scaled_defaults
from surffollow.hw.driver import ConversionQueue, DriverInfo, PoseQueue
from surffollow.service import memory as m
from surffollow.service.answers import params_hash
from surffollow.service.shared_objects import SharedObjects
from surffollow.shm import layout_board as lb
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_follow import (
    CHANNELS,
    INTERVALS,
    MODE_ADAPTIVE,
    POSES,
    STOP_RESTART,
    STOP_START,
    Params,
)
from surffollow.shm.ring import make_ring

CHANGES = 1 << 14  # entries for the audit trail between two looks of the main thread


def make_sample_ring(config: ServiceConfig, period_ns: int) -> tuple[NDArray[Any], int]:
    """The map's queue with its capacity in samples, every page touched: not in a cycle."""
    per_second = min(CHANNELS * 1e9 / period_ns, 25000)
    capacity = 1 << max(12, int(np.ceil(np.log2(config.map.queue_seconds * per_second))))
    ring = make_ring(capacity, m.SAMPLE_WORDS)
    ring[:] = 0
    return ring, capacity


def initialise_memory(
    config: ServiceConfig,
    objects: SharedObjects,
    queue: ConversionQueue,
    samples: tuple[NDArray[Any], int],
    reports: PoseQueue | None = None,
    pushed: Any = None,
) -> m.CycleMemory:
    """Memory of the cycle thread, which knows where everything lies and how it is to run.

    Parameters
    ----------
    config : ServiceConfig
    objects : SharedObjects                     the service's shared memory
    queue : ConversionQueue           what the driver fills
    samples : ring and capacity       of `make_sample_ring`; must live as long as the memory
    reports : PoseQueue, optional     where accepted poses go, for a simulated sensor
    pushed : record, optional         of a driver whose ranges clients push (`pushed_of`)
    """
    mem = m.make_cycle_memory(objects.map_header, objects.pairs, pushed)
    ctx = mem.ctx
    period = int(objects.header[0]["period_ns"])
    ctx[m.PERIOD_NS] = period
    # a FIFO thread that never sleeps starves every other one of its processor; a quarter of 100 us is
    # less than a busy kernel takes to wake it (median lateness 9 us, with half of it 9 ns)
    spin = round(seconds(config.realtime.spin, "realtime.spin", 0.0, 0.01) * 1e9)
    ctx[m.SPIN_NS] = min(spin, period // 2)
    ctx[m.CATCH_UP] = int(config.realtime.overrun == "catch-up")
    for index, part in (
        (m.OUTPUT, "output"),
        (m.PARAMS_LATCH, "params"),
        (m.ACKS, "acks"),
        (m.MAP_ACKS, "map_acks"),
        (m.MAP_STATUS, "map_status"),
        (m.STATS, "stats"),
        (m.LOG, "log"),
    ):
        ctx[index] = objects.address(part)
    ctx[m.LOG_CAPACITY] = config.log_words
    ctx[m.SLOTS_AT] = objects.slots.address
    ctx[m.CONVERSIONS], ctx[m.CONVERSIONS_CAPACITY] = queue.address, queue.capacity
    if reports is not None:
        ctx[m.REPORTS], ctx[m.REPORTS_CAPACITY] = reports.address, reports.capacity
    ctx[m.SAMPLES], ctx[m.SAMPLES_CAPACITY] = samples[0].ctypes.data, samples[1]
    snapshot = seconds(config.snapshot, "snapshot", 0.01, 3600.0)
    ctx[m.SNAPSHOT_CYCLES] = max(1, round(snapshot * 1e9 / period))
    ctx[m.LEASE_NS] = round(seconds(config.map.access_lease, "map.access_lease", 0.01, 3600.0) * 1e9)
    ctx.view(np.float64)[m.QUANTUM] = map_quantum_m(config)
    ctx[m.EPOCH] = objects.epoch
    ctx[m.PARAMS_BY] = CHANGED_BY.index(config.access.parameters)
    ctx[m.MAP_BY] = CHANGED_BY.index(config.access.map)
    ctx[m.RANGES_BY], ctx[m.OWN_USER] = range_user(config.access.ranges), own_user()
    for name, ends in client_limits(config.limits).items():
        mem.bounds[Params.offset(name) // 8, 3:5] = ends
    _begin_stopped(mem, config, objects)
    return mem


def _begin_stopped(mem: m.CycleMemory, config: ServiceConfig, objects: SharedObjects) -> None:
    """A stop outlives the service: only the pose's holder ends it."""
    kept, known = int(objects.map_header[0]["stop"]), (1 << len(STOP_NAMES)) - 1
    causes = kept & known
    if kept & ~known:  # of another release: stopped all the same
        causes |= STOP_START
    mem.state[0]["stop"] = causes | (stop_causes(config.stop.on) & STOP_START)


def stop_after_end(mem: m.CycleMemory, objects: SharedObjects) -> bool:
    """Stop when the service before ended with other parameters in force than those of this start.

    Its clients attach to this one by themselves; without the stop the robot would move to another stand-off,
    within other limits, without a request. A requested end without a robot leaves no parameters behind
    (`forget_parameters`).
    """
    kept = objects.map_header[0]
    differ = int(kept["params_hash"]) not in (0, int(params_hash(mem)))
    if differ:
        mem.state[0]["stop"] |= STOP_RESTART
        kept["stop"] = mem.state[0]["stop"]  # before the hash is that of this start
    return differ


def forget_parameters(mem: m.CycleMemory, objects: SharedObjects) -> bool:
    """At a requested end: the next start need not stop where no client that is there holds the pose.

    Returns
    -------
    bool  whether the parameters are forgotten
    """
    slot = int(mem.ctx[m.POSE_SLOT])
    held = slot >= 0 and mem.ctx[m.CLAIM + slot] == mem.ctx[m.POSE_CLAIM]
    if not held:
        objects.map_header[0]["params_hash"] = 0
    return not held


def make_change_queue(mem: m.CycleMemory) -> NDArray[Any]:
    """The audit trail's queue, known to the cycle; must live as long as the memory."""
    ring = make_ring(CHANGES, lb.AUDIT_ENTRY_WORDS)
    ring[:] = 0
    mem.ctx[m.CHANGES], mem.ctx[m.CHANGES_CAPACITY] = ring.ctypes.data, CHANGES
    return ring


def initialise_constants(params: Any, config: ServiceConfig, info: DriverInfo) -> None:
    """Fill in the parameters: their defaults, what the driver says of its sensors, the configuration.

    Raises
    ------
    ConfigError  window, stand-off and fold-back do not fit each other, or a value is beyond [limits]
    """
    assert 2 * PARAMS["range_size"].high <= INTERVALS
    assert POSES & (POSES - 1) == 0
    p = params[0]
    for name, spec in PARAMS.items():
        p[name] = spec.default
    p["n_channels"] = info.n_channels
    p["scale_m"], p["zero_m"] = info.scale_m, info.zero_m
    p["range_min_m"], p["range_max_m"] = info.range_min_m, info.range_max_m
    p["sensor_latency_ns"] = info.latency_ns
    p["tool_from_sensor"] = np.array(info.mounts, np.float64).reshape(-1)
    p["stop_on"] = stop_causes(config.stop.on)
    given = follow_params(config)
    near, far = given.get("range_min_m", info.range_min_m), given.get("range_max_m", info.range_max_m)
    offset, tau = (given.get(n, PARAMS[n].default) for n in ("offset_m", "plant_tau_s"))
    p["too_close_m"], p["too_close_exit_m"] = default_too_close(near, far, offset)
    if given.get("mode", PARAMS["mode"].default) == MODE_ADAPTIVE:
        for name, value in scaled_defaults(offset, tau).items():
            p[name] = value
    for name, value in given.items():
        p[name] = value
    check_fit({name: float(p[name]) for name in FITTED})
    # defaults follow from driver, stand-off and time constant: only now are all of them known
    check_within_limits({name: float(p[name]) for name in PARAMS}, client_limits(config.limits))


def initialise_log(config: ServiceConfig, objects: SharedObjects) -> None:
    """An empty cycle log and an empty audit trail in the board."""
    log_header = zeros(lb.LogHead)
    log_header[0]["capacity"] = config.log_words
    at = objects.regions["log"][0]
    objects.board_bytes[at : at + lb.LogHead.SIZE] = log_header.view(np.uint8)
    log_header[0]["capacity"] = lb.AUDIT_WORDS
    at = objects.regions["audit"][0]
    objects.board_bytes[at : at + lb.LogHead.SIZE] = log_header.view(np.uint8)
