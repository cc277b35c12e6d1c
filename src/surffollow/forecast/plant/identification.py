"""Plant identification: the axis model nearest to the pose reports tells the time constant."""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.estimation.noise import LEAST_SHARE
from surffollow.forecast.plant.shadow_axes import TAU_RATIO, advance_plants, place_plants
from surffollow.shm.jit import jit
from surffollow.shm.layout_multimodel import N_MODELS, N_PLANTS

MEMORY_TAUS = 60.0  # of the squared errors, in time constants
RATE_TAUS = 12.0  # in which the time constant in force approaches the one found
ASTRAY_SHARE = 0.03  # of the stand-off: a tool farther from every model does not follow the demands
CONTRAST = 0.5  # share by which the worst squared error must exceed the best one


@jit
def identify(m: Any, learn: Any) -> None:
    """Compare the axis models with a new report and move τ toward the best one's.

    A report that no model comes near (somebody else leads the robot) places the models at the tool.
    """
    p, k, s = m.plant, m.kinematics, m.shadow
    if p.tau_told != m.reference.tau:
        p.tau = p.tau_told = m.reference.tau
        p.reports = 0
        for i in range(N_PLANTS):
            p.error[i] = 0.0
        place_plants(m)
    dt = k.pose_t - s.plants_t
    if dt == 0.0:
        return
    if dt < 0.0 or dt > 8.0 * p.tau or s.ticks == 0 or m.setpoint.active == 0:
        place_plants(m)
        return
    advance_plants(m)
    least = math.inf
    for i in range(N_PLANTS):
        least = min(least, abs(s.z[N_MODELS + i] - k.z))
    if not least < ASTRAY_SHARE * m.reference.standoff:
        place_plants(m)
        return
    if learn == 0:
        return
    p.reports += 1
    rate = max(1.0 - math.exp(-dt / (MEMORY_TAUS * p.tau_told)), 1.0 / p.reports)
    for i in range(N_PLANTS):
        e = s.z[N_MODELS + i] - k.z
        p.error[i] += rate * (e * e - p.error[i])
    tau = _best(m)
    if tau > 0.0:
        p.tau *= math.exp((1.0 - math.exp(-dt / (RATE_TAUS * p.tau_told))) * math.log(tau / p.tau))


@jit
def _best(m: Any) -> Any:
    """Time constant of the least error, by a parabola over √τ through three models; 0: not told."""
    p = m.plant
    b, worst = 0, 0.0
    for i in range(N_PLANTS):
        worst = max(worst, p.error[i])
        if p.error[i] < p.error[b]:
            b = i
    floor = LEAST_SHARE * m.reference.standoff
    if worst - p.error[b] < max(CONTRAST * p.error[b], floor * floor):
        return 0.0
    b = min(max(b, 1), N_PLANTS - 2)
    middle = math.sqrt(p.tau_told * TAU_RATIO ** (b - N_PLANTS // 2))
    left, right = middle / math.sqrt(TAU_RATIO), middle * math.sqrt(TAU_RATIO)
    down = (p.error[b] - p.error[b - 1]) / (middle - left)
    up = (p.error[b + 1] - p.error[b]) / (right - middle)
    bend = (up - down) / (right - left)
    if bend <= 0.0:
        return middle * middle
    root = min(max(0.5 * (left + middle - down / bend), left), right)
    return root * root


@jit
def reset_identification(m: Any) -> None:
    """Begin with the time constant told."""
    m.plant.tau_told = 0.0
