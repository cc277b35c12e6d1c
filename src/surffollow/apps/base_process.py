"""The simulated base as a process: commands in, blocks and a log out."""

from __future__ import annotations

import contextlib
import csv
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from surffollow.apps.base_blocks import Base, TrueBase, publish
from surffollow.apps.ending_signals import ending_signals
from surffollow.apps.wall_figures import Run, find_turns
from surffollow.arbiter import command_reader, observe
from surffollow.blocks import mem_attach
from surffollow.errors import NotRunningError
from surffollow.map.formats.atomic_file import replacing
from surffollow.sim.base import BaseConfig, SimulatedBase

BASE_HZ, CLIENT_HZ = 100.0, 50.0
ROUND_S = 0.15  # one round of the ring, and a little
WAIT_NOTICE_S = 1.0  # without a command, until a line says what the base waits for
LOG_COLUMNS = ("t_s", "x_m", "y_m", "heading_rad", "gap_m", "client")


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
    say : callable       gets a line of text when the base has to wait for its first command

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
        log_rows(log) as write,
        mem_attach({"base": Base, "true_base": TrueBase}, name, write=True) as blocks,
        ending_signals() as ended,
    ):
        base.run(ROUND_S)
        began, commanded, since = time.monotonic() - base.time_s, False, time.monotonic()
        while base.time_s < seconds and not ended:
            command = commands.latest()
            if not commanded and command.safe:  # the clients are not there yet: stand still in time, too
                publish(base, blocks["base"], blocks["true_base"], time.monotonic_ns())
                began = time.monotonic() - base.time_s
                if say is not None and time.monotonic() - since > WAIT_NOTICE_S:
                    say(waited_for(name))
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


def waited_for(name: str) -> str:
    with contextlib.suppress(NotRunningError), observe(name) as seen:
        if seen.status()["alive"]:
            return f"the base waits for a client of arbiter {name!r} to command it; Ctrl-C ends it"
    return f"the base waits: no arbiter {name!r} runs here (surffollow arbiter start FILE); Ctrl-C ends it"


@contextlib.contextmanager
def log_rows(path: str | None) -> Iterator[Callable[[tuple[float, ...]], object]]:
    """Writer of rows to a log; the file stands beside its name from the first moment on."""
    if path is None:
        yield lambda row: None
        return
    with replacing(path) as part, part.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(LOG_COLUMNS)
        yield lambda row: table.writerow([*(f"{v:.6f}" for v in row[:-1]), row[-1]])


def read_log(path: Path, names: list[str], numbers: dict[int, str]) -> Run:
    """A base's log as a run; `numbers` maps the arbiter's client numbers to names."""
    table = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
    who = {number: names.index(name) for number, name in numbers.items() if name in names}
    holder = np.array([who.get(int(c), -1) for c in table[:, 5]], np.int64)
    time_s, x_m, y_m, heading_rad, gap_m = (table[:, k].copy() for k in range(5))
    run = Run(names, time_s, x_m, y_m, heading_rad, gap_m, holder)
    run.turns = find_turns(run)
    return run
