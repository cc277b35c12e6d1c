"""Demonstrate a shared tool: service, arbiter, robot, follower and avoider as processes of their own."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from surffollow.apps.child_processes import Child, no_leftovers, running
from surffollow.apps.demo_task import DemoConfig, config_file, robot_words
from surffollow.apps.obstacle_avoidance import avoid
from surffollow.apps.shared_tool import SIX
from surffollow.arbiter import observe
from surffollow.errors import FaultError, UsageError

OBSTACLE_M, HEIGHT_M, LIFT_M = (0.42, 0.48), 0.12, 0.05
AWAY_M = 0.16  # distance from the edge beyond which the tool must be at its stand-off
READY_TIMEOUT_S = 180.0

ARBITER = """
[clients]
follow = 10
avoid = 40
RESOURCES
"""


def arbiter_text(combine: str) -> str:
    """The arbiter's configuration: one resource, or the sum of two."""
    fields, zeros = ", ".join(f'"{n}"' for n in SIX), ", ".join(["0.0"] * len(SIX))
    one = f'command = [{fields}]\nsafe = [{zeros}]\nstatus = "tool_status"\n'
    if combine == "priority":
        return ARBITER.replace("RESOURCES", f"[resources.tool]\n{one}")
    parts = f"[resources.follow]\n{one}\n[resources.offset]\n{one}\n"
    # limit of the follower's demand and of the lift together
    limits = "low = [-0.2, -0.2, -0.2, -0.5, -0.5, -0.5]\nhigh = [0.2, 0.2, 0.2, 0.5, 0.5, 0.5]\n"
    both = f'[combine.tool]\nparts = ["follow", "offset"]\nrequired = ["follow"]\n{limits}'
    return ARBITER.replace("RESOURCES", parts + both)


def _await(what: Callable[[], Any], child: Child) -> None:
    deadline = time.monotonic() + READY_TIMEOUT_S
    while True:
        if child.child.poll() is not None:
            raise child.fail(f"ended with code {child.child.returncode} before it was ready")
        try:
            if what():
                return
        except FaultError:
            pass
        if time.monotonic() > deadline:
            raise child.fail(f"was not ready after {READY_TIMEOUT_S:.0f} s")
        time.sleep(0.05)


def _alive(name: str) -> bool:
    from surffollow.client import observe as observe_service

    with observe_service(name) as watcher:
        return bool(watcher.alive())


def _server_alive(name: str) -> bool:
    with observe(name) as watcher:
        return bool(watcher.alive())


def run_shared_demo(
    seconds: float, combine: str, folder: Path, progress: Callable[[str], None]
) -> dict[str, Any]:
    """Run it all over flat ground with one obstacle across the path.

    Parameters
    ----------
    seconds : float [s]  of motion
    combine : str        "priority" or "sum"
    folder : Path        receives the files
    progress : callable  gets a line of text

    Returns
    -------
    dict   stand-off over the obstacle and away from it [m], who led how often; `failures`, empty when none

    Raises
    ------
    UsageError     `combine` is neither "priority" nor "sum"
    SurffollowError
    """
    if combine not in ("priority", "sum"):
        raise UsageError(f"combine is {combine!r}; use 'priority' or 'sum'")
    name = f"shared-{os.getpid()}"
    config = DemoConfig(seconds=seconds, surface="flat", path="line")
    trace, toml = folder / "robot.npz", folder / "arbiter.toml"
    toml.write_text(arbiter_text(combine))
    follows, lifts = ("tool", "tool") if combine == "priority" else ("follow", "offset")
    over = threading.Event()
    found: dict[str, Any] = {}

    def watch() -> None:
        try:
            found.update(
                avoid(name, lifts, OBSTACLE_M, LIFT_M, over.is_set, margin_m=0.1, add=combine == "sum")
            )
        except FaultError as e:
            found["fault"] = str(e)

    with no_leftovers(name):
        service_words = ["start", "--name", name, "--config", str(config_file(config, folder))]
        arbiter_words = ["arbiter", "start", "--quiet", "--name", name, str(toml)]
        follow_words = ["arbiter", "follow", "--name", name, "--service", name, "--resource", follows]
        with (
            running("service", service_words, folder) as service,
            running("arbiter", arbiter_words, folder) as arbiter,
        ):
            _await(lambda: _alive(name), service)
            _await(lambda: _server_alive(name), arbiter)
            progress("service and arbiter are ready")
            watcher = threading.Thread(target=watch, name="avoid")
            with running("follower", follow_words, folder), observe(name) as history:
                watcher.start()
                words = [*robot_words(config, name, trace), "--arbiter", name]
                with running("robot", words, folder) as robot:
                    summary = robot.result(seconds + 120.0)
                over.set()
                watcher.join(10.0)
                status = history.status()
    return _figures(trace, combine, summary, status, found)


def _figures(
    trace: Path, combine: str, summary: dict[str, Any], status: dict[str, Any], found: dict[str, Any]
) -> dict[str, Any]:
    import numpy as np

    with np.load(trace) as columns:
        x, standoff, counts = columns["x_m"], columns["standoff_m"], columns["scored"] > 0
    above = (x > OBSTACLE_M[0]) & (x < OBSTACLE_M[1]) & counts
    away = ((x < OBSTACLE_M[0] - AWAY_M) | (x > OBSTACLE_M[1] + AWAY_M)) & counts
    least = float(standoff[above].min()) if above.any() else None
    rms = float(np.sqrt(np.mean((standoff[away] - 0.1) ** 2))) if away.any() else None
    failures = []
    if least is None or least < HEIGHT_M:
        failures.append(f"the tool came within {least} m of the ground over an obstacle of {HEIGHT_M} m")
    if rms is None or rms > 2e-3:
        failures.append(f"away from the obstacle the stand-off was kept to {rms} m rms, not 2 mm")
    if found.get("passages", 0) < 1 or "fault" in found:
        failures.append(f"the avoider never led the tool: {found}")
    return {
        "combine": combine,
        "least_standoff_over_obstacle_m": least,
        "obstacle_m": HEIGHT_M,
        "standoff_rms_away_m": rms,
        "passages": found.get("passages", 0),
        "held_ticks": summary["held_ticks"],
        "ticks": summary["ticks"],
        "resources": {
            n: {k: r[k] for k in ("grants", "preempted", "forwarded", "rejected")}
            for n, r in status["resources"].items()
        },
        "failures": failures,
    }
