"""Wall following by processes: an arbiter, a simulated base, and one process for each client."""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from pathlib import Path
from typing import Any

from surffollow.apps.base_blocks import Base, sensing_of
from surffollow.apps.base_process import CLIENT_HZ, read_log
from surffollow.apps.child_processes import Child, running
from surffollow.apps.ending_signals import ending_signals
from surffollow.apps.wall_clients import PRIORITIES, make_clients
from surffollow.apps.wall_figures import Run
from surffollow.apps.wall_following import ring_of
from surffollow.arbiter import attach, observe
from surffollow.blocks import mem_attach
from surffollow.errors import BlockError, NotRunningError, RequestTimeoutError, ServiceError, UsageError
from surffollow.sim.base import BaseConfig

SILENT_S = 5.0  # a base that publishes nothing for so long ended; a busy machine may hold it up for a second

ARBITER = """name = "{name}"

[clients]
{clients}

[resources.robot]
command = ["speed", "turn_rate"]
units = ["m/s", "rad/s"]
safe = [0.0, 0.0]
low = [-0.5, -1.0]
high = [0.5, 1.0]
status = "{name}.base"
"""


def arbiter_config(name: str) -> str:
    """The configuration of the arbiter of the experiments, as TOML."""
    clients = "\n".join(f"{client} = {priority}" for client, priority in PRIORITIES.items())
    return ARBITER.format(name=name, clients=clients)


def run_client(name: str, client: str, experiment: str, config: BaseConfig | None = None) -> dict[str, Any]:
    """Run one client until the base falls silent or a signal ends it.

    Parameters
    ----------
    name : str           of arbiter and base
    client : str         one of the experiment's clients
    experiment : str
    config : BaseConfig  of the base; None: the usual one

    Returns
    -------
    dict   steps, commands, requests

    Raises
    ------
    UsageError       the experiment has no such client
    NotRunningError  no arbiter, or no base
    """
    made = {c.name: c for c in make_clients(experiment, ring_of(config or BaseConfig()))}
    if client not in made:
        raise UsageError(f"experiment {experiment!r} has no client {client!r}; it has {', '.join(made)}")
    brain, steps, sent, asked = made[client], 0, 0, 0
    with (
        attach(name, client) as arbiter,
        mem_attach({"base": Base}, name) as blocks,
        ending_signals() as ended,
    ):
        robot, received = arbiter.resource("robot"), time.monotonic()
        last_ns = 0
        while not ended and arbiter.connected:
            time.sleep(1.0 / CLIENT_HZ)
            got = sensing_of(blocks["base"])
            if got is None or got[1] == last_ns:
                if time.monotonic() - received > SILENT_S:
                    break
                continue
            seen, last_ns = got
            received = time.monotonic()
            wish = brain.step(seen, robot.held)
            steps += 1
            with contextlib.suppress(RequestTimeoutError):  # the arbiter paused: the next step asks again
                if wish.desired and not robot.held:
                    asked += 1
                    robot.request(timeout_s=0.5)
                elif not wish.desired and robot.held:
                    robot.relinquish()
            if wish.desired and robot.held:
                sent += robot.command(wish.speed, wish.turn_rate)
    return {"client": client, "steps": steps, "commands": sent, "requests": asked}


def run_processes(
    experiment: str,
    seconds: float,
    *,
    seed: int = 1,
    name: str = "",
    start: tuple[float, float, float] = BaseConfig.start,
) -> tuple[Run, list[Any]]:
    """Run an experiment as processes in real time.

    Parameters
    ----------
    start : (x, y, heading)   of the base [m, m, rad]

    Returns
    -------
    Run, list   the true motion with the client obeyed at each time; the arbiter's history

    Raises
    ------
    ServiceError  a process did not start or ended with an error
    """
    name = name or f"wall{os.getpid()}"
    names = [c.name for c in make_clients(experiment, ring_of(BaseConfig()))]
    with tempfile.TemporaryDirectory() as text, contextlib.ExitStack() as stack:
        folder = Path(text)
        (folder / "arbiter.toml").write_text(arbiter_config(name))
        log = folder / "base.csv"
        arbiter = stack.enter_context(
            running("arbiter", ["arbiter", "start", str(folder / "arbiter.toml")], folder)
        )
        _await_ready(arbiter)
        words = ["base", "--name", name, "--seconds", str(seconds), "--seed", str(seed), "--log", str(log)]
        words += ["--start", *map(str, start), "--json"]
        base = stack.enter_context(running("base", words, folder))
        _await_base(name, base)
        numbers: dict[int, str] = {}
        children = [arbiter]
        for client in names:  # the one that drives comes last
            words = ["base-client", client, "--name", name, "--experiment", experiment, "--json"]
            child = stack.enter_context(running(client, words, folder))
            children.append(child)
            numbers = _await_clients(name, names[: names.index(client) + 1], child)
        _await_end(base, children, seconds + 60.0)
        with observe(name) as seen:
            history = seen.history(oldest=True).newest(4096)
        run = read_log(log, names, numbers)
    return run, history


def _await_end(base: Child, others: list[Child], timeout_s: float) -> None:
    """Wait for the end of the base; the others outlive it, or the run is another experiment."""
    deadline, ended = time.monotonic() + timeout_s, False
    while not ended:
        ended = base.child.poll() is not None
        for child in others:
            if (code := child.child.poll()) is not None:
                raise child.fail(f"ended during the run with code {code}")
        if time.monotonic() >= deadline:
            raise base.fail(f"did not end in {timeout_s:.0f} s")
        time.sleep(0.0 if ended else 0.05)
    base.result(timeout_s)


def _await_ready(child: Child, timeout_s: float = 90.0) -> None:
    deadline = time.monotonic() + timeout_s
    assert child.child.stdout is not None
    while time.monotonic() < deadline:
        line = child.child.stdout.readline()
        if line.startswith("READY"):
            return
        if not line:
            break
    raise child.fail("did not get ready")


def _await_clients(name: str, expected: list[str], child: Child, timeout_s: float = 90.0) -> dict[int, str]:
    """Wait until these clients are attached; their names by the arbiter's numbers."""
    deadline = time.monotonic() + timeout_s
    numbers: dict[int, str] = {}
    with observe(name) as seen:
        while time.monotonic() < deadline and child.child.poll() is None:
            numbers = {int(c["number"]): str(c["name"]) for c in seen.status()["clients"]}
            if set(expected) <= set(numbers.values()):
                return numbers
            time.sleep(0.02)
    missing = [client for client in expected if client not in numbers.values()]
    raise child.fail(f"waited for clients that are not attached ({', '.join(missing)})")


def _await_base(name: str, child: Child, timeout_s: float = 90.0) -> None:
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if child.child.poll() is not None:
            raise child.fail("ended at once")
        with contextlib.suppress(BlockError, NotRunningError), mem_attach({"base": Base}, name) as blocks:
            if sensing_of(blocks["base"]) is not None:
                return
        time.sleep(0.05)
    raise ServiceError(f"the base {name!r} published nothing in {timeout_s:g} s")
