"""Leave out one mechanism of the default follower after the other, and see what each is worth.

Every variant is a change of its source in a copy of the package. Printed per variant, over the full follower:
geometric means of the RMS over surfaces without sines, over sines, with a sensor that leads by 50 mm, on a
second pass over ground that is remembered, over the cases of `bench_scales`, with a sensor of 2 Hz and with
bursts of wrong readings; the worst of these but the last two; the acceleration of the setpoints; and the
greatest excursion after slots and glitches.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from surffollow.sim.profiles_measured import data_dir

ROOT = Path(__file__).resolve().parent.parent
FORECAST = Path("surffollow/forecast")
SURFACES = (
    "ramp-5",
    "ramp-20",
    "step",
    "hump",
    "bumps",
    "rough-smooth-rough",
    "iso-c",
    "fy91",
    "jacksboro",
    "microscope",
    "weld",
    "hull",
    "casting",
    "lap-joints",
    "pipes",
    "terrain",
    "sine-100",
    "sine-400",
    "chirp",
)
SINES = ("sine-100", "sine-400", "chirp")
SPEEDS_MPS, LEADS_M = (0.1, 0.4), (0.0, 0.05)
AGAIN = ("ramp-20", "step", "bumps", "fy91", "microscope", "casting", "pipes", "terrain", "chirp")
SCALES = ("publish", "tune")
SCALE_SEEDS = 2
SENSORS = {"2 Hz": "slow", "bursts": "bursts"}
SENSOR_GROUNDS, SENSOR_SEEDS = ("terrain", "hull", "casting"), 4
EXCURSIONS, EXCURSION_SEEDS = ("slot", "glitch"), 15

# name: (module, text, its replacement) …
VARIANTS: dict[str, list[tuple[str, str, str]]] = {
    "full": [],
    "powers without sharpness": [("model_weights", "(s * s * alpha * alpha)", "1.0")],
    "chance penalty": [("model_weights", "s * s * chance", "0.0")],
    "part of the lead left out": [("setpoint_lead", "lead.left_out[i] = 1.0", "lead.left_out[i] = 0.0")],
    "recent horizon of the lead": [
        ("setpoint_lead", "((i, recent_rate), (WAVES + i, longer_rate))", "((WAVES + i, longer_rate),)")
    ],
    "filter of the weights": [
        ("model_weights", "rate = 1.0 - elementary.exp(", "rate = 1.0 - 0.0 * elementary.exp(")
    ],
    "effort power": [
        (
            "model_weights",
            "p_e = 0.8 * ((1.0 - s) * (1.0 - s)) + 6.0",
            "p_e = 0.0 * ((1.0 - s) * (1.0 - s)) + 0.0",
        )
    ],
    "second sample in the gate": [
        (
            "innovation_gate",
            "if not inner_m < abs(innovation_m) <= gate.width_m or",
            "if inner_m >= 0.0 or",
        )
    ],
    "likelihood of slots": [
        ("innovation_gate", "max(0.3 * gate.slot_likelihood", "max(1.0 * gate.slot_likelihood")
    ],
    "settling after a start or a loss": [("estimate", "t_ns + 60_000_000", "t_ns + 0")],
    "clamp of the slope": [
        ("setpoint_blend", "max_slope = max(creeps * quantities.PLAUSIBLE_SLOPE,", "max_slope = max(1e6,")
    ],
    "noise of a longer path": [
        (
            "estimate",
            "stretch = 1.0 if is_slow(adaptive) else moved_m / way",
            "stretch = 1.0",
        )
    ],
    "wider gate where noise grows": [("innovation_gate", "gate.scale_m *= 1.25", "gate.scale_m *= 1.0")],
    "step taken back in a loss": [
        (
            "setpoint_blend",
            "if dropout > 0.0 and gate.step_m < 0.0 and recent and",
            "if dropout > 1e9 and",
        )
    ],
    "extrapolation by the bank": [
        (
            "preview",
            "rise = bank_rise(adaptive, end_m + min(x, PREDICTION_M)) - before",
            "rise = 0.0 * before",
        )
    ],
    "reversion to the mean": [("preview", "reversion = 1.5", "reversion = 0.0")],
    "bound of an early descent": [
        (
            "preview_control",
            "lowest, least = ground_m[0], -params.plant_v_max_mps",
            "lowest, least = -1e9, -1e9",
        )
    ],
    "curve models": [("model_bank", "for qc in (3.0, 20.0, 150.0)]", "for qc in (20.0, 20.0, 20.0)]")],
    "wave models": [("model_bank", "for m in (0.6, 0.6 *", "for m in (1e3, 1e3 *")],
    "deadband": [
        (
            "setpoint_blend",
            "deadband_m = params.deadband_share * permitted",
            "deadband_m = 1e-12 * permitted",
        ),
    ],
    "limits behind a fall": [("setpoint_limits", "factor = params.toward_factor if", "factor = 1.0 if")],
    "two samples of slow sensors": [
        ("pending_samples", "late = is_long(needed * interval_s, tau_s)", "late = False"),
        ("sample_hold", "return is_long(adaptive.hold.interval_s", "return is_long(0.0"),
    ],
    "learned waiting time": [
        (
            "controller_clock",
            "return min(params.max_wait_s, 0.5e-9 * controller.interval_ns)",
            "return params.max_wait_s",
        )
    ],
    "adaptive wave numbers": [("estimate", "model_bank.adapt_waves(bank, h_m, r, way)", "pass")],
    "path at rest": [
        ("kinematics", "return GROUND_SPEED_MPS if", "return 1e-3 if"),
        ("estimate", "kinematics.GROUND_SPEED_MPS * dt", "1e-3 * dt"),
    ],
    "decaying slopes": [
        ("model_bank", "((0.006, 8.0), (0.015, 4.0), (0.05, 2.0))", "((1e3, 0.0), (1e3, 0.0), (1e3, 0.0))")
    ],
    "levels but one": [("model_bank", "for qh in (3e-5, 1e-3)]", "for qh in (3e-4, 3e-4)]")],
    "longer horizon": [
        (
            "model_weights",
            "c += p_l * elementary.log(weights.longer_m2",
            "c += 0.0 * elementary.log(weights.longer_m2",
        )
    ],
    "recent horizon": [
        (
            "model_weights",
            "c = p_j * elementary.log(weights.recent_m2",
            "c = 0.0 * elementary.log(weights.recent_m2",
        )
    ],
    "noise subtracted from the index": [
        ("model_weights", "noise_j = params.noise_share", "noise_j = 0.0"),
        ("model_weights", "noise_l = params.noise_share", "noise_l = 0.0"),
    ],
    "effort power on rough ground": [
        (
            "model_weights",
            "p_e = 0.8",
            "p_e = 0.0",
        )
    ],
    "more samples in a burst": [("pending_samples", "int(0.25 * tau_s", "int(0.0 * tau_s")],
    "wider gate of sparse samples": [
        (
            "innovation_gate",
            "adaptive), quantities.PLAUSIBLE_SLOPE * travel_m\n",
            "adaptive), 0.0 * travel_m\n",
        ),
        (
            "innovation_gate",
            "adaptive), quantities.PLAUSIBLE_SLOPE * travel_m)",
            "adaptive), 0.0 * travel_m)",
        ),
    ],
    "wrong samples taken back": [("earlier_bank", "1 if is_slow(adaptive) else 0", "0")],
    "confirmed drops of known ground": [
        ("known_ground", "(0.0 if late else adaptive.known.descent_m)", "0.0")
    ],
    "descent limit in a loss": [
        ("setpoint_blend", "        z = max(z, blend.tracked_m - MAX_UNCONFIRMED_DESCENT_M)", "        pass")
    ],
    "test of the response": [("response", "if late or far or sign == layout.SIGN_FOR_HOLD:", "if False:")],
    "heights by the axis model": [("observed_axis", "0.0 < plant.scatter_m <", "0.0 > plant.scatter_m <")],
    "disturbance of the axis": [
        ("plant_identification", "AXIS_GAINS = (0.3, 2.0, 0.1)", "AXIS_GAINS = (0.3, 2.0, 0.0)")
    ],
    "shift before a steep hold": [("response", "STEEP = 0.5", "STEEP = 1e9")],
    "shift before a hold": [("constant_ranges", "SHIFT_DESCENT = 0.25", "SHIFT_DESCENT = 1e9")],
    "repeated ranges": [("repeated_ranges", "if repeats.count == 0 or", "if True or")],
}


def cell_trial(job: tuple[str, float, float, int]) -> tuple[float, float]:
    """RMS [m] and acceleration [m/s²] of one cell of the benchmark."""
    from surffollow.benchmark.conditions import Conditions
    from surffollow.benchmark.runner import run_method, scene_of, score_run
    from surffollow.benchmark.suite import Cell

    surface, speed, lead, seed = job
    scene = scene_of(Cell(surface, speed, Conditions().but(lead_m=lead)), seed)
    score = score_run(scene, *run_method("ours", scene))
    return score.rms_m, score.demand_accel_mps2


def again_trial(job: tuple[str, float, int]) -> float:
    """RMS of a second pass over the same ground [m]."""
    from surffollow.benchmark.conditions import Conditions
    from surffollow.benchmark.trials import Job, second_pass

    surface, speed, seed = job
    return float(second_pass(Job("second-pass", "ours", seed, Conditions(), surface, speed))["second_m"])


def excursion_trial(job: tuple[str, float, int]) -> float:
    """Greatest excursion of the setpoint after slots or glitches [m]."""
    from surffollow.benchmark.conditions import Conditions
    from surffollow.benchmark.trials import Job, excursion

    case, speed, seed = job
    return float(excursion(Job("excursion", "ours", seed, Conditions(), "flat", speed, case))["excursion_m"])


def scale_trial(job: tuple[str, str, int]) -> float:
    """RMS of a case of `bench_scales` [m]."""
    from bench_scales import run_follower
    from scale_cases import CASES

    which, name, seed = job
    return run_follower(next(c for c in CASES[which] if c.name == name), "ours", seed)


def trial(job: tuple[str, tuple[Any, ...]]) -> list[float]:
    """Figures of one run: RMS [m] and acceleration [m/s²], RMS alone, or an excursion [m]."""
    kind, what = job
    if kind == "cell":
        return list(cell_trial(what))  # type: ignore[arg-type]
    trials: dict[str, Any] = {"again": again_trial, "excursion": excursion_trial}
    return [trials.get(kind, scale_trial)(what)]


def measure(seeds: Sequence[int]) -> list[list[Any]]:
    """All figures of the follower that is imported: rows of kind, job, figures."""
    from scale_cases import CASES

    jobs: list[tuple[str, tuple[Any, ...]]] = [
        ("cell", (s, v, lead, seed))
        for s in SURFACES
        for v in SPEEDS_MPS
        for lead in LEADS_M
        for seed in seeds
    ]
    jobs += [("again", (s, v, seeds[0])) for s in AGAIN for v in SPEEDS_MPS]
    jobs += [
        ("scale", (which, c.name, seeds[0] + k))
        for which in SCALES
        for c in CASES[which]
        for k in range(SCALE_SEEDS)
    ]
    jobs += [
        ("sensor", ("rows", f"{sensor}, {ground}", seeds[0] + k))
        for sensor in SENSORS
        for ground in SENSOR_GROUNDS
        for k in range(SENSOR_SEEDS)
    ]
    jobs += [
        ("excursion", (c, v, seeds[0] + k))
        for c in EXCURSIONS
        for v in SPEEDS_MPS
        for k in range(EXCURSION_SEEDS)
    ]
    return [[kind, list(what), *trial((kind, what))] for kind, what in jobs]


def run_variant(name: str, seeds: str) -> list[list[Any]]:
    """Measure a variant in a copy of the package, in a process of its own that compiles its kernels."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "src"
        shutil.copytree(ROOT / "src", source, ignore=shutil.ignore_patterns("__pycache__"))
        for module, text, other in VARIANTS[name]:
            path = next((source / FORECAST).rglob(f"{module}.py")).resolve()
            before = path.read_text()
            if before.count(text) != 1:
                raise SystemExit(f"{name}: {module} has {before.count(text)} times: {text}")
            path.write_text(before.replace(text, other))
        environment = {
            **os.environ,
            "SURFFOLLOW_DATA": str(data_dir()),
            "PYTHONPATH": os.pathsep.join((str(source), str(ROOT / "tools"))),
            "SURFFOLLOW_CACHE_DIR": str(Path(folder) / "cache"),
        }
        done = subprocess.run(
            [sys.executable, __file__, "--measure", "--seeds", seeds],
            env=environment,
            capture_output=True,
            text=True,
        )
        if done.returncode:
            raise SystemExit(f"{name}: {done.stderr[-2000:]}")
        return list(json.loads(done.stdout))


def geometric_mean(values: Sequence[float]) -> float:
    return math.exp(sum(map(math.log, values)) / len(values))


def compare(found: list[list[Any]], full: list[list[Any]]) -> dict[str, float]:
    """Figures of a variant over those of the full follower."""
    cells = {tuple(f[1]): f[2] / g[2] for f, g in zip(found, full) if f[0] == "cell"}
    scales = [f[2] / g[2] for f, g in zip(found, full) if f[0] == "scale"]
    again = [f[2] / g[2] for f, g in zip(found, full) if f[0] == "again"]
    sensors: dict[str, list[float]] = {column: [] for column in SENSORS.values()}
    for f, g in zip(found, full):
        if f[0] == "sensor":
            sensors[SENSORS[f[1][1].partition(",")[0]]].append(f[2] / g[2])

    def of(keep: Any) -> float:
        return geometric_mean([x for job, x in cells.items() if keep(job)])

    return {
        "rms": of(lambda j: j[2] == 0.0 and j[0] not in SINES),
        "sines": of(lambda j: j[2] == 0.0 and j[0] in SINES),
        "lead": of(lambda j: j[2] > 0.0),
        "again": geometric_mean(again),
        "scales": geometric_mean(scales),
        **{column: geometric_mean(ratios) for column, ratios in sensors.items()},
        "worst": max(*cells.values(), *again, *scales),
        "acceleration": geometric_mean([f[3] / g[3] for f, g in zip(found, full) if f[0] == "cell"]),
        "excursion_m": max(f[2] for f in found if f[0] == "excursion"),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Run the variants, some side by side."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", default="340:341")
    parser.add_argument("--processes", type=int, default=2, help="variants side by side")
    parser.add_argument("--variant", action="append", choices=list(VARIANTS), help="only these")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args(argv)
    first, last = map(int, given.seeds.split(":"))
    if given.measure:
        print(json.dumps(measure(range(first, last))))
        return 0
    if data_dir() is None:
        parser.error("the measured grounds are missing: set SURFFOLLOW_DATA to the folder of the real data")
    names = ["full", *[v for v in given.variant or VARIANTS if v != "full"]]
    rows: dict[str, dict[str, float]] = {}
    if not given.json:
        print(
            "| left out | RMS | sines | lead 50 mm | second pass | scales | slow | bursts | worst |"
            " acceleration | excursion [mm] |"
        )
        print("| --- |" + " ---: |" * 10)
    with ThreadPoolExecutor(given.processes) as pool:
        full: list[list[Any]] = []
        for name, found in zip(names, pool.map(lambda name: run_variant(name, given.seeds), names)):
            full = full or found
            row = rows[name] = compare(found, full)
            if not given.json:
                print(
                    f"| {name} | {row['rms']:.3f} | {row['sines']:.3f} | {row['lead']:.3f} |"
                    f" {row['again']:.3f} | {row['scales']:.3f} |"
                    f" {row['slow']:.3f} | {row['bursts']:.3f} | {row['worst']:.2f} |"
                    f" {row['acceleration']:.2f} |"
                    f" {1e3 * row['excursion_m']:.3f} |",
                    flush=True,
                )
    if given.json:
        print(json.dumps(rows, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
