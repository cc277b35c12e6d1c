"""Wall following by processes: an arbiter, a simulated base, and one process for each client."""

from __future__ import annotations

import contextlib
import csv
import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from surffollow.apps.base_blocks import Base, TrueBase, publish, sensing_of
from surffollow.apps.child_processes import Child, running
from surffollow.apps.wall_clients import PRIORITIES, make_clients
from surffollow.apps.wall_following import Run, find_turns, ring_of
from surffollow.arbiter import attach, command_reader, observe
from surffollow.blocks import mem_attach
from surffollow.errors import BlockError, NotRunningError, ServiceError, UsageError
from surffollow.map.formats.atomic_file import replacing
from surffollow.sim.base import BaseConfig, SimulatedBase

BASE_HZ, CLIENT_HZ = 100.0, 50.0
ROUND_S = 0.15  # one round of the ring, and a little
PATIENCE_S = 1.0  # without a command, until people are told what the base waits for
SILENT_S = 1.0  # a base that publishes nothing for this long ended
LOG_COLUMNS = ("t_s", "x_m", "y_m", "heading_rad", "gap_m", "client")

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


def run_base(
    name: str,
    seconds: float,
    *,
    seed: int = 1,
    log: str | None = None,
    config: BaseConfig | None = None,
    say: Callable[[str], object] | None = None,
) -> dict[str, Any]:
    """Run the simulated base in real time: obey the arbiter's commands, publish the blocks, write a log.

    Its time begins with the first command of a client.

    Parameters
    ----------
    name : str           of the arbiter and the blocks
    seconds : float      of motion
    log : str            CSV file: time, true pose, gap, number of the client whose command was obeyed
    say : callable       gets a line for people when the base has to wait for its first command

    Returns
    -------
    dict   seconds, least_gap_m, obeyed (commands by client number)

    Raises
    ------
    MapFileError  the log cannot be written where it shall be
    """
    base, commands = SimulatedBase(config, seed), command_reader(name, "robot")
    obeyed: dict[int, int] = {}
    gap = base.wall_gap_m
    with (
        _log_rows(log) as write,
        mem_attach({"base": Base, "true_base": TrueBase}, name, write=True) as blocks,
        ended_by_signal() as ended,
    ):
        base.run(ROUND_S)
        began, commanded, since = time.monotonic() - base.time_s, False, time.monotonic()
        while base.time_s < seconds and not ended:
            command = commands.latest()
            if not commanded and command.safe:  # the clients are not there yet: stand still in time, too
                publish(base, blocks["base"], blocks["true_base"], time.monotonic_ns())
                began = time.monotonic() - base.time_s
                if say is not None and time.monotonic() - since > PATIENCE_S:
                    say(_waited_for(name))
                    say = None
                time.sleep(1.0 / BASE_HZ)
                continue
            commanded = True
            client = 0 if command.safe else command.client
            base.command(*((0.0, 0.0) if command.safe else command.values[:2]))
            base.run(min(time.monotonic() - began, base.time_s + 0.2))
            publish(base, blocks["base"], blocks["true_base"], time.monotonic_ns())
            obeyed[client] = obeyed.get(client, 0) + 1
            gap = min(gap, base.wall_gap_m)
            x, y, heading = (float(v) for v in base.state[:3])
            write((base.time_s, x, y, heading, base.wall_gap_m, client))
            time.sleep(max(0.0, began + base.time_s + 1.0 / BASE_HZ - time.monotonic()))
    return {"seconds": base.time_s, "least_gap_m": gap, "obeyed": obeyed}


def _waited_for(name: str) -> str:
    with contextlib.suppress(NotRunningError), observe(name) as seen:
        if seen.status()["alive"]:
            return f"the base waits for a client of arbiter {name!r} to command it; Ctrl-C ends it"
    return f"the base waits: no arbiter {name!r} runs here (surffollow arbiter start FILE); Ctrl-C ends it"


@contextlib.contextmanager
def _log_rows(path: str | None) -> Iterator[Callable[[tuple[float, ...]], object]]:
    """What appends a row to a log; the file stands beside its name from the first moment on."""
    if path is None:
        yield lambda row: None
        return
    with replacing(path) as part, part.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(LOG_COLUMNS)
        yield lambda row: table.writerow([*(f"{v:.6f}" for v in row[:-1]), row[-1]])


@contextlib.contextmanager
def ended_by_signal() -> Any:
    """A list that gets an entry when SIGINT or SIGTERM arrives."""
    caught: list[int] = []
    before = {
        n: signal.signal(n, lambda number, _: caught.append(number)) for n in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run_client(name: str, client: str, experiment: str, config: BaseConfig | None = None) -> dict[str, Any]:
    """Run one client until the base falls silent or a signal ends it.

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
        ended_by_signal() as ended,
    ):
        robot, heard = arbiter.resource("robot"), time.monotonic()
        last_ns = 0
        while not ended and arbiter.connected:
            time.sleep(1.0 / CLIENT_HZ)
            got = sensing_of(blocks["base"])
            if got is None or got[1] == last_ns:
                if time.monotonic() - heard > SILENT_S:
                    break
                continue
            seen, last_ns = got
            heard = time.monotonic()
            wish = brain.step(seen, robot.held)
            steps += 1
            if wish.wanted and not robot.held:
                asked += 1
                robot.request(timeout_s=0.5)
            elif not wish.wanted and robot.held:
                robot.relinquish()
            if wish.wanted and robot.held:
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
        for client in names:  # the one that drives comes last
            words = ["base-client", client, "--name", name, "--experiment", experiment, "--json"]
            child = stack.enter_context(running(client, words, folder))
            numbers = _await_clients(name, names[: names.index(client) + 1], child)
        base.result(seconds + 60.0)
        with observe(name) as seen:
            history = seen.history(oldest=True).newest(4096)
        run = read_log(log, names, numbers)
    return run, history


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
    with observe(name) as seen:
        while time.monotonic() < deadline and child.child.poll() is None:
            numbers = {int(c["number"]): str(c["name"]) for c in seen.status()["clients"]}
            if set(expected) <= set(numbers.values()):
                return numbers
            time.sleep(0.02)
    raise child.fail("did not attach")


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


def read_log(path: Path, names: list[str], numbers: dict[int, str]) -> Run:
    """A base's log as a run; `numbers` maps the arbiter's client numbers to names."""
    table = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
    who = {number: names.index(name) for number, name in numbers.items() if name in names}
    holder = np.array([who.get(int(c), -1) for c in table[:, 5]], np.int64)
    time_s, x_m, y_m, heading_rad, gap_m = (table[:, k].copy() for k in range(5))
    run = Run(names, time_s, x_m, y_m, heading_rad, gap_m, holder)
    run.turns = find_turns(run)
    return run
