"""The kernel of the response test decides as its plain twin does, sample by sample."""

from __future__ import annotations

import math

import numpy as np

from naive_response import HOLD, LIFT, NONE, RUN, NaiveResponse
from surffollow.forecast.sensing.response import is_unresponsive, observe_response
from surffollow.forecast.setpoint.tested_setpoint import setpoint_range, setpoint_shift_m
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.shm.layout_adaptive_sensing import ROTATION_FAILED, ROTATION_RUN

from .feeding import default_params

PHASES = RUN, HOLD, LIFT, NONE
ESTIMATES = "mean_m", "range_m", "top_z_m", "low_z_m"
STANDOFF_M, SIGMA_M, GAP_S = 0.1, 2.5e-4, 0.2


def states_seen(seed: int) -> set[tuple[str, bool]]:
    """Drive kernel and twin with an axis that obeys the test; ground, noise and faults are drawn."""
    rng = np.random.default_rng(seed)
    tau_s, interval_s = float(rng.choice([0.02, 0.1])), float(rng.choice([0.004, 0.03]))
    lead_m = float(rng.choice([0.0, 0.0, 0.05]))
    params, adaptive = default_params(), zeros(AdaptiveState)[0]
    params["offset_m"] = STANDOFF_M
    adaptive["plant"]["tau_s"] = tau_s
    adaptive["noise"]["sigma_m"], adaptive["noise"]["range_sigma_m"] = 3.0 * SIGMA_M, SIGMA_M  # poses, too
    adaptive["weights"]["scored"] = 500
    adaptive["hold"]["interval_s"], adaptive["sample"]["lead_m"] = interval_s, lead_m
    adaptive["latency"]["delay_s"] = delay_s = float(rng.choice([0.0, 0.04]))
    rotation_failed = bool(rng.random() < 0.2)
    adaptive["rotation"]["phase"] = ROTATION_FAILED if rotation_failed else ROTATION_RUN
    twin = NaiveResponse(tau_s, interval_s, STANDOFF_M, SIGMA_M, GAP_S, lead_m, delay_s, rotation_failed)
    count_m = float(rng.choice([0.0, 2e-5, 5e-4]))  # none, far below the noise, a coarse sensor
    twin.sigma_m = max(SIGMA_M, count_m / math.sqrt(12.0))  # of the quantisation at least
    twin.noise_m = SIGMA_M
    twin.count_m = adaptive["hold"]["least_m"] = count_m
    adaptive["hold"]["changes"] = 8
    seen, t_ns, z, ground, stuck = set(), 1_000_000, STANDOFF_M, 0.0, None
    in_kernel, in_twin = [], []
    slope, noisy, disobeys = 0.0, True, False
    for k in range(1500):
        if k % 150 == 0:
            slope = float(rng.choice([0.0, -0.05, -0.2, -0.8, 0.1, 0.5]))
            stuck = STANDOFF_M + float(rng.choice([0.0, 5e-4, 4e-3, -2e-3])) if rng.random() < 0.6 else None
            noisy = rng.random() < 0.7
            twin.applied = rng.random() < 0.8
            disobeys = rng.random() < 0.1  # another controller moves the tool up
        adaptive["setpoint"]["t_ns"] = int(twin.applied)
        t_ns += round(1e9 * (GAP_S * 2 if rng.random() < 2e-3 else interval_s))
        ground += slope * interval_s
        read = (z - ground if stuck is None else stuck) + SIGMA_M * rng.standard_normal() * noisy
        read += 0.02 * (rng.random() < 5e-3)
        read = round(read / count_m) * count_m if count_m > 0.0 else read
        descent, twin.descent_m, spread_m = adaptive["descent"], None, 0.0
        if k > 10 and rng.random() < 4e-3:  # one that its ranges do not explain
            twin.descent_m = low, high = twin.mean_m - 2e-3 * rng.random(), twin.mean_m + 2e-3 * rng.random()
            descent["least_m"], descent["most_m"], spread_m = low, high, 0.5 * (high - low)
        observe_response(params, adaptive, t_ns, read, z, spread_m)
        twin.observe(t_ns, read, z)
        record, repeats = adaptive["response"], adaptive["repeats"]
        assert PHASES[record["phase"]] == twin.phase, (seed, k)
        assert is_unresponsive(record) == (twin.phase == NONE)
        assert repeats["unused"] == twin.unused, (seed, k)
        in_kernel.append([repeats["count"], repeats["usual"], *(adaptive["run"][n] for n in ESTIMATES)])
        in_twin.append(
            (twin.repeats, twin.usual_repeats, twin.mean_m, twin.run_m, twin.top_z_m, twin.low_z_m)
        )
        target = z + STANDOFF_M - read
        adaptive["clock"]["now_ns"] = t_ns
        lowest, highest = setpoint_range(adaptive, 0.0)
        asked = min(max(target + setpoint_shift_m(record), lowest), highest)
        expected = twin.target_in_test_m(target)
        assert abs(asked - expected) <= max(1e-12, 1e-6 * abs(expected)), (seed, k)
        z += (asked - z) * min(1.0, interval_s / tau_s)
        z += 0.2 * interval_s * disobeys
        twin.setpoint_m = adaptive["setpoint"]["position_m"] = asked
        twin.climb_mps = adaptive["kinematics"]["climb_mps"] = float(rng.choice([0.0, 0.1, -0.1]))
        seen.add((twin.phase, twin.phase in (HOLD, LIFT) and twin.rose))
    # a row for each sample
    np.testing.assert_allclose(in_kernel, in_twin, rtol=1e-9, err_msg=f"seed {seed}")
    return seen


def test_the_kernel_decides_as_the_twin_in_every_phase():
    """GIVEN drawn grounds and faults WHEN both see the same samples THEN they agree in every sample."""
    expected = {(phase, False) for phase in PHASES} | {(LIFT, True)}
    assert set.union(*(states_seen(seed) for seed in range(30))) == expected
