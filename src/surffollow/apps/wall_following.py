"""The wall-following experiments in simulated time: base, clients, and the arbiter's own state machine.

The machine that grants the base is `arbiter.machine.transition` over the table that the server executes.
`wall_processes` runs the same clients as processes over a real arbiter.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

import surffollow.arbiter.table as t
from surffollow.apps.wall_clients import PRIORITIES, make_clients
from surffollow.apps.wall_figures import Run, find_turns
from surffollow.apps.wall_sensing import BaseClient, Sensing
from surffollow.arbiter.machine import transition
from surffollow.arbiter.records import MAX_EFFECTS, Clients, Effect, Machine, StateEvent
from surffollow.errors import UsageError
from surffollow.shm.dtypes import numpy_dtype, zeros
from surffollow.sim.base import (
    HEADING,
    ODOMETRY_HEADING,
    ODOMETRY_SPEED,
    ODOMETRY_TURN_RATE,
    ODOMETRY_X,
    ODOMETRY_Y,
    BaseConfig,
    SimulatedBase,
    X,
    Y,
)
from surffollow.sonar.ring import SonarRing

EXPERIMENTS = ("paper", "1", "1-pair", "2")
TICK_S = 0.02
MAX_S = 2000.0
SHORT_OF_DEG = 20.0  # of the last turn: a run ends so much before the lap does


def ring_of(config: BaseConfig) -> SonarRing:
    """The sonars of a base, as the estimator needs to know them."""
    return SonarRing.regular(
        config.sonars,
        config.radius_m,
        config.half_beam_rad,
        max_incidence_rad=config.max_incidence_rad,
        range_sigma=config.range_noise,
        max_range_m=config.max_range_m,
    )


def sense(base: SimulatedBase) -> Sensing:
    """Part of a simulated base that clients may read."""
    s = base.state
    return Sensing(
        base.time_s,
        (float(s[ODOMETRY_X]), float(s[ODOMETRY_Y]), float(s[ODOMETRY_HEADING])),
        float(s[ODOMETRY_SPEED]),
        float(s[ODOMETRY_TURN_RATE]),
        base.sonar_m,
        base.sonar_s,
        base.infrared_m,
    )


class Arbitration:
    """One resource and its clients, in simulated time.

    Attributes
    ----------
    holder : int      index of the client that holds the base; −1: none
    """

    def __init__(self, names: list[str]) -> None:
        self._table = np.array(t.encode(), np.int64)
        self._machine, self._clients = zeros(Machine), zeros(Clients)
        self._state_event, self._effects = zeros(StateEvent), np.zeros(MAX_EFFECTS, numpy_dtype(Effect))
        self._machine[0]["holder"] = -1
        self._clients[0]["n"] = len(names)
        for k, name in enumerate(names):
            self._clients[0]["priority"][k], self._clients[0]["live"][k] = PRIORITIES[name], 1

    @property
    def holder(self) -> int:
        return int(self._machine[0]["holder"])

    def _apply_event(self, event: int, client: int, token: int = 0, guards: int = 0) -> list[int]:
        h = self._state_event[0]
        h["event"], h["client"], h["token"], h["guards"] = event, client, token, guards
        n = transition(self._table, self._machine, self._clients, self._state_event, self._effects)
        return [int(self._effects[k]["action"]) for k in range(n)]

    def request(self, client: int) -> bool:
        """Ask for the base; whether it is the client's now."""
        self._apply_event(t.REQUEST, client)
        return self.holder == client

    def relinquish(self, client: int) -> None:
        """Give the base back."""
        self._apply_event(t.RELINQUISH, client)

    def command(self, client: int) -> bool:
        """Whether a command of this client is forwarded."""
        token = int(self._machine[0]["token"])
        return t.FORWARD in self._apply_event(t.COMMAND, client, token, t.FRESH | t.SOUND)


def run_experiment(experiment: str, *, laps: int = 4, seed: int = 1, config: BaseConfig | None = None) -> Run:
    """Run one experiment in simulated time until the base has turned `laps` times about, less SHORT_OF_DEG.

    Parameters
    ----------
    experiment : {"paper", "1", "1-pair", "2"}
    laps : int
    seed : int                    of noise and slip, and of the start
    config : BaseConfig

    Raises
    ------
    UsageError  no such experiment, or no laps
    """
    if experiment not in EXPERIMENTS:
        raise UsageError(f"experiment {experiment!r} is unknown; choose one of {', '.join(EXPERIMENTS)}")
    if laps < 1:
        raise UsageError(f"{laps} laps say nothing; ask for at least 1")
    config = config or BaseConfig()
    rng = np.random.default_rng([seed, 7])
    x, y, heading = config.start
    start = (x, y, heading + math.radians(2.0) * float(rng.standard_normal()))
    base = SimulatedBase(replace(config, start=start), seed)
    clients = make_clients(experiment, ring_of(config))
    arbitration = Arbitration([c.name for c in clients])
    rows: list[tuple[float, float, float, float, float, int]] = []
    base.run(0.15)  # one round of the ring
    goal = start[2] + 2.0 * math.pi * laps - math.radians(SHORT_OF_DEG)
    while base.state[HEADING] < goal and base.time_s < MAX_S:
        tick(base, clients, arbitration)
        base.run(base.time_s + TICK_S)
        s = base.state
        rows.append(
            (base.time_s, float(s[X]), float(s[Y]), float(s[HEADING]), base.wall_gap_m, arbitration.holder)
        )
    columns = list(zip(*rows))
    time_s, x_m, y_m, heading_rad, gap_m, holder = (np.array(c) for c in columns)
    run = Run([c.name for c in clients], time_s, x_m, y_m, heading_rad, gap_m, holder)
    run.turns = find_turns(run)
    run.ended = (
        f"the time of {MAX_S:.0f} s was over before lap {laps} was done"
        if base.state[HEADING] < goal
        else f"lap {laps} counts as done {SHORT_OF_DEG:.0f}° before its end"
    )
    return run


def tick(base: SimulatedBase, clients: list[BaseClient], arbitration: Arbitration) -> None:
    """Let every client look, ask or give back, and forward the holder's command."""
    seen = sense(base)
    wishes = []
    for k, client in enumerate(clients):
        wish = client.step(seen, arbitration.holder == k)
        wishes.append(wish)
        if wish.desired and arbitration.holder != k:
            arbitration.request(k)
        elif not wish.desired and arbitration.holder == k:
            arbitration.relinquish(k)
    holder = arbitration.holder
    if holder >= 0 and arbitration.command(holder):
        base.command(wishes[holder].speed, wishes[holder].turn_rate)
    else:
        base.command(0.0, 0.0)  # the safe command
