"""A height with the wrong sign leads each demand away from the stand-off: the first motion shows it."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from surffollow import Follower
from surffollow.benchmark.job_loop import BOOM, CELL, Job, follow
from surffollow.forecast.sensing import frame_check
from surffollow.forecast.sensing.mean_range import samples_in_mean
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.shm.layout_adaptive_sensing import (
    FRAME_HELD,
    FRAME_LIFTED,
    FRAME_LOWERED,
    FRAME_REVERSED,
    FRAME_RIGHT,
    FRAME_UNKNOWN,
)
from surffollow.shm.layout_follow import Params

DRONE = Job(5.0, 0.5, 0.05, 0.02, 2.0, 3.0, 0.02, (0.5, 20.0))
SLOW = Job(3.0, 0.4, 0.1, 0.05, 2.0, 3.0, 0.03, (0.3, 12.0))
TORCH = Job(0.004, 0.02, 0.001, 0.001, 0.1, 2.0, 10e-6, (0.001, 0.02))
JOBS = {"cell": CELL, "boom": BOOM, "drone": DRONE, "10 Hz": SLOW, "torch": TORCH}


def level(x_m: float, t_s: float) -> float:
    return 0.0


@pytest.mark.parametrize("above", [-0.3, -0.1, 0.1])
@pytest.mark.parametrize("name", JOBS)
def test_a_negated_height_ends_the_demands_far_above_the_ground(name, above):
    """GIVEN heights with the wrong sign THEN demands end with 0.4 stand-offs left, with a reason."""
    job = JOBS[name]
    run = follow(job, level, 40 * job.tau_s, height_sign=-1.0, above_m=above * job.standoff_m)
    print(f"{name}, {above:+}: least clearance {run.clearance_m.min() / job.standoff_m:.2f} stand-offs")
    assert run.clearance_m.min() > 0.4 * job.standoff_m
    assert run.clearance_m.max() < 1.45 * job.standoff_m
    assert "VALID" not in run.states[-1]["status"]
    assert run.states[-1]["health"] == "FAULT"
    assert "shrinks when the tool rises" in run.states[-1]["reason"]
    assert "REVERSED" in run.states[-1]["faults"]
    assert any("the tool is held or raised" in state["reason"] for state in run.states)


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("ground", ["hills", "heave", "ramp", "step"])
@pytest.mark.parametrize("name", JOBS)
def test_a_right_frame_over_ground_that_moves_has_a_demand_throughout(name, ground, seed):
    """GIVEN a start over hills, ramps, edges or a deck that heaves THEN nothing is taken as reversed."""
    job = JOBS[name]
    s0, tau = job.standoff_m, job.tau_s
    heights = {
        "hills": lambda x, t: 0.3 * s0 * math.sin(t / tau / 6) + 0.2 * s0 * math.sin(t / tau / 17),
        "heave": lambda x, t: 0.3 * s0 * math.sin(t / tau / 4),
        "ramp": lambda x, t: 0.12 * s0 * t / tau,
        "step": lambda x, t: 0.4 * s0 / (1.0 + math.exp(6.0 - t / tau)),
    }
    speed = 0.0 if ground == "heave" else 0.5 * s0 / tau
    run = follow(job, heights[ground], 30 * tau, speed_mps=speed, seed=seed)
    print(f"{name}, {ground}, seed {seed}: least clearance {run.clearance_m.min() / s0:.2f} stand-offs")
    assert all("REVERSED" not in s["faults"] and s["health"] != "FAULT" for s in run.states)
    assert run.clearance_m.min() > 0.6 * s0


def test_a_reset_begins_the_check_anew():
    """GIVEN a height that was found reversed WHEN the sign is mended and SFReset comes THEN it is VALID."""
    f = Follower({"sensors": [{"near_m": 0.03, "far_m": 0.3}]}, offset_m=0.1)

    def run(first_ms: int, last_ms: int, sign: float, height_m: float) -> float:
        for ms in range(first_ms, last_ms, 4):
            f.pose(ms * 1_000_000, (0.0, 0.0, sign * height_m, 0.0, 0.0, 0.0, 1.0))
            demand = float(f.step(ms * 1_000_000, [height_m])[2])
            height_m += 0.1 * sign * demand
        return height_m

    height_m = run(4, 3000, -1.0, 0.09)
    assert "REVERSED" in f.state()["faults"]
    assert run(3000, 4000, -1.0, height_m) == height_m
    f.reset()
    height_m = run(4000, 8000, 1.0, height_m)
    assert f.state()["faults"] == []
    assert "VALID" in f.state()["status"]
    assert abs(height_m - 0.1) < 1e-3


@pytest.mark.parametrize("name", JOBS)
def test_a_sensor_ahead_over_hills_is_not_taken_as_reversed(name):
    """GIVEN the only sensor half a stand-off ahead, and hills THEN nothing is taken as reversed."""
    job = JOBS[name]
    s0, tau = job.standoff_m, job.tau_s
    for seed in range(8):
        phase, length = np.random.default_rng(seed).uniform((0.0, 2.0), (6.3, 8.0))
        print(f"{name}: seed {seed}, phase {phase}, length {length}")

        def hills(x: float, t: float, phase: float = phase, length: float = length) -> float:
            return 0.3 * s0 * math.sin(x / (length * s0) + phase)

        run = follow(job, hills, 25 * tau, speed_mps=0.25 * s0 / tau, ahead_m=0.5 * s0, seed=seed)
        assert all("REVERSED" not in s["faults"] for s in run.states)


@pytest.mark.parametrize("rate", [0.01, 0.02, 0.05, 0.1, 0.2])
def test_a_pilot_who_climbs_half_as_fast_as_the_ground_is_not_taken_as_reversed(rate):
    """GIVEN a tool that another controller leads over ground that rises twice as fast THEN no fault."""
    f = Follower({"sensors": [{"near_m": 0.5, "far_m": 20.0}], "plant": {"tau_s": 0.5}}, offset_m=5.0)
    rng = np.random.default_rng(1)
    for k in range(1, 400):
        climb_m = rate * 5.0 / 0.5 * k * 0.05
        if climb_m > 4.0:
            break
        f.pose(k * 50_000_000, (0.3 * k, 0.0, 8.0 + climb_m, 0.0, 0.0, 0.0, 1.0))
        f.step(k * 50_000_000, [8.0 - climb_m + 0.01 * float(rng.standard_normal())])
        assert f.state()["faults"] == []


class NaiveFrameCheck:
    """The check with all samples of a phase in a list."""

    def __init__(self, least_m: float, wait_ns: int) -> None:
        self.phase, self.least_m, self.wait_ns = FRAME_UNKNOWN, least_m, wait_ns
        self.samples: list[tuple[int, float, float]] = []
        self.setpoint_m = 0.0

    def add(self, t_ns: int, range_m: float, z_m: float) -> None:
        if self.phase in (FRAME_RIGHT, FRAME_REVERSED):
            return
        sample = (t_ns, range_m, z_m)
        self.samples.append(sample)
        change = {
            "z": np.ptp([z for _, _, z in self.samples]),
            "difference": np.ptp([r - z for _, r, z in self.samples]),
            "sum": np.ptp([r + z for _, r, z in self.samples]),
        }
        moved = change["z"] > self.least_m
        waited_ns = t_ns - self.samples[0][0]
        late = waited_ns > self.wait_ns
        obeyed = late and abs(z_m - self.setpoint_m) < self.least_m
        if moved and change["difference"] < 0.5 * change["sum"]:
            self.phase = FRAME_RIGHT
        elif self.phase == FRAME_UNKNOWN:
            if moved and change["sum"] < 0.15 * change["difference"]:
                self.phase, self.samples, self.setpoint_m = FRAME_HELD, [sample], z_m
        elif self.phase == FRAME_HELD:
            if obeyed:
                self.phase, self.samples = FRAME_LIFTED, [sample]
                self.setpoint_m = z_m + 2.0 * self.least_m
            elif waited_ns > 2 * self.wait_ns or change["sum"] > self.least_m:
                self.phase, self.samples = FRAME_UNKNOWN, [sample]
        elif obeyed and moved and change["sum"] < 0.5 * change["difference"]:
            self.phase = FRAME_LOWERED if self.phase == FRAME_LIFTED else FRAME_REVERSED
            self.samples, self.setpoint_m = [sample], self.setpoint_m - 2.0 * self.least_m
        elif late:
            self.phase, self.samples = FRAME_UNKNOWN, [sample]


def records():
    """Parameters and state of a follower with a sample each 10 ms."""
    params, a = zeros(Params).view(np.recarray)[0], zeros(AdaptiveState).view(np.recarray)[0]
    params.offset_m = 0.1
    a.plant.tau_s, a.hold.interval_s, a.latency.delay_s = 0.04, 0.01, 0.005
    a.noise.sigma_m = a.noise.range_sigma_m = 2e-4
    return params, a


def lead_away(params, a, first: int, z_m: float = 0.2, close: bool = False) -> set[int]:
    """Phases of 200 samples under a tool that obeys, with the wrong sign and the range 0.1 m at 0.2 m."""
    phases, start_m = set(), z_m
    for k in range(first, first + 200):
        held = FRAME_HELD <= a.frame.phase <= FRAME_LOWERED
        z_m += 0.3 * (a.frame.setpoint_m - z_m) if held else 5e-4
        frame_check.observe_frame(params, a, close, k * 10_000_000, 0.1 - (z_m - start_m), z_m)
        phases.add(int(a.frame.phase))
    return phases


def test_a_jump_of_the_frame_begins_the_check_anew():
    """GIVEN a height that jumps far WHEN the tool is led away THEN a wrong sign is found behind the jump."""
    params, a = records()
    frame_check.observe_frame(params, a, False, 10_000_000, 0.1, -0.8)
    a.kinematics.jump_ns = 20_000_000
    assert FRAME_REVERSED in lead_away(params, a, 2)


@pytest.mark.parametrize("speed_mps", [0.0, 0.1])
@pytest.mark.parametrize("lead_m", [0.0, 0.05, -0.05])
def test_a_sensor_beside_the_tool_is_checked_at_rest(lead_m, speed_mps):
    """GIVEN a lead or a trail WHEN the tool travels THEN the check waits; at rest it decides."""
    params, a = records()
    a.sample.lead_m, a.kinematics.speed_mps = lead_m, speed_mps
    waits = lead_m != 0.0 and speed_mps > 0.0
    assert (lead_away(params, a, 1) == {FRAME_UNKNOWN}) == waits


def test_a_known_fold_back_is_no_wrong_sign():
    """GIVEN a sensor that may be nearer than its near limit THEN the check waits."""
    params, a = records()
    assert lead_away(params, a, 1, close=True) == {FRAME_UNKNOWN}
    assert FRAME_REVERSED in lead_away(params, a, 201)


@pytest.mark.parametrize("seed", range(20))
def test_the_check_is_that_of_its_twin(seed):
    """GIVEN tools that wander over ground that moves WHEN the ranges have either sign THEN twins agree."""
    rng = np.random.default_rng(seed)
    params, a = records()
    wait_s = 0.005 + 2.0 * 0.04 + 2.0 * samples_in_mean(a) * 0.01
    naive = NaiveFrameCheck(max(0.05 * 0.1, 6.0 * 2e-4), int(1e9 * wait_s))
    sign, z, ground, seen = rng.choice([-1.0, 1.0]), 0.2, 0.0, SimpleNamespace(phases=set())
    share, obeys = rng.choice([0.0, 0.5, 2.0]), rng.random() < 0.7
    for k in range(600):
        moves = naive.phase in (FRAME_HELD, FRAME_LIFTED, FRAME_LOWERED) and obeys
        wanted = naive.setpoint_m if moves else z + 2e-3 * rng.normal()
        step = 0.2 * (wanted - z)
        z, ground = z + step, ground + share * step * (k < 500)
        r = 0.1 + sign * (z - 0.2) - ground + 2e-4 * float(rng.standard_normal())
        t_ns = (k + 1) * 10_000_000
        frame_check.observe_frame(params, a, False, t_ns, r, z)
        naive.add(t_ns, r, z)
        seen.phases.add(naive.phase)
        found = a.frame.phase, a.frame.setpoint_m
        assert found == (naive.phase, naive.setpoint_m), f"seed {seed}, sample {k}"
    print(f"seed {seed}: sign {sign}, ground {share}, phases {sorted(seen.phases)}")
