"""Compare the ways to execute a scan plan with the live follower, over maps with errors of several kinds.

Each row is a run of the real service in wall time: a simulated arm with sag, modes and sway follows the plan
made over a wrong map; the simulated sensor rides on the real tip. Ways: `plan` (no sensor), `sensor` (the
follower alone, no map), `map` (the plan's map installed, the follower's demand alone) and `feedforward`
(the plan's height, corrected by the demand); `shaped`: what the demand asks for passes a ZVD shaper.
Figures: range along the tool's axis minus the wanted one, and the least distance of the detector's control
points from the true ground.

    python tools/bench_scan_run.py [--speed 0.25] [--first 100] [--seeds 8] [--json]

Constants of the arm and of the follower were chosen on seed 0. Printed: median and worst of the seeds.
There are no criteria. A run takes the time of its path, all of them hours; Ctrl-C prints the rows so far.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from report import machine, show_step
from surffollow.apps.child_processes import no_leftovers, running
from surffollow.apps.demo import _await_ready
from surffollow.apps.scan_figures import sensed_figures, true_figures
from surffollow.apps.scan_robot_config import ScanRobotConfig
from surffollow.apps.scan_run import execute
from surffollow.client import attach
from surffollow.map import HeightMap
from surffollow.scan.body import disc
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.plan import PlanSettings, plan_scan
from surffollow.scan.shaping import Shaper
from surffollow.scan.timing import MotionLimits
from surffollow.sim.surfaces import HeightField

KINDS = ("exact", "offset", "tilt", "missing object", "phantom object")
MODE_HZ, DAMPING = 4.5, 0.04  # of the arm up and down, as a ring-down gives them
LATERAL_DAMPING = 0.03  # and sideways
WAYS = {  # name: way of the robot, map installed, demands shaped
    "plan": ("plan", False, False),
    "sensor": ("map", False, False),
    "sensor shaped": ("map", False, True),
    "map": ("map", True, False),
    "map shaped": ("map", True, True),
    "feedforward": ("feedforward", False, False),
    "feedforward shaped": ("feedforward", False, True),
}
FIELD, REGION, GRID_M = (-0.2, 0.0, 1.4, 0.7), (0.2, 0.2, 1.0, 0.5), 5e-3
GAP_M, RADIUS_M = 0.06, 0.05
OFFSET_M, TILT_RAD, OBJECT_M, OBJECT_AT, OBJECT_WIDTH_M = 0.01, np.radians(2.0), 0.02, (0.6, 0.35), 0.12
CONFIG = """
[realtime]
priority = 50
[map]
grids = 200000
[driver]
kind = "simulated"
[driver.led]
window_m = [0.015, 0.25]
[driver.world]
file = "{file}"
[follow]
mode = "adaptive"
offset = {offset}
too_close_m = 0.016
too_close_exit_m = 0.018
range_min_m = 0.0155
range_max_m = 0.245
max_demand_m = 0.2
plant_v_max_mps = 0.5
plant_a_max_mps2 = 4.0
"""


def grounds(kind: str, seed: int) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """True heights and mapped heights over FIELD."""
    cols, rows = (round((FIELD[k + 2] - FIELD[k]) / GRID_M) for k in (0, 1))
    x, y = np.meshgrid(*(FIELD[k] + (np.arange(n) + 0.5) * GRID_M for k, n in ((0, cols), (1, rows))))
    rng = np.random.default_rng(seed)
    true = np.zeros_like(x)
    for _ in range(20):
        angle, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        k = 2.0 * np.pi / rng.uniform(0.35, 1.0)
        true += np.cos(k * (x * np.cos(angle) + y * np.sin(angle)) + phase)
    true *= 0.008 / true.std()
    far = np.hypot(x - OBJECT_AT[0], y - OBJECT_AT[1])
    thing = OBJECT_M * 0.5 * (1.0 - np.tanh((far - 0.5 * OBJECT_WIDTH_M) / 0.01))
    if kind == "offset":
        return true, true + OFFSET_M
    if kind == "tilt":
        return true, true + np.tan(TILT_RAD) * (x - 0.6)
    if kind == "missing object":
        return true + thing, true
    if kind == "phantom object":
        return true, true + thing
    return true, true


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--speed", type=float, default=0.25)
    words.add_argument("--first", type=int, default=100, help="first seed")
    words.add_argument("--seeds", type=int, default=8)
    words.add_argument("--ways", default=",".join(WAYS))
    words.add_argument("--kinds", default=",".join(KINDS))
    words.add_argument("--acceleration", type=float, default=2.66, help="of the plan [m/s²]")
    words.add_argument("--lateral-hz", type=float, default=2.0, help="planar shaper (ZVD); 0: not shaped")
    words.add_argument("--mode-hz", type=float, default=MODE_HZ, help="that the shaper is made for")
    words.add_argument("--json", action="store_true")
    args = words.parse_args()
    rows: list[dict[str, Any]] = []
    kinds = args.kinds.split(",")
    total, start = args.seeds * len(kinds) * len(args.ways.split(",")), time.monotonic()

    def show_row(row: dict[str, Any]) -> None:
        done, spent_s = row["number"], time.monotonic() - start
        left_min = spent_s / done * (total - done) / 60.0
        show_step(
            f"run {done} of {total}: {row['map']}, {row['way']}: RMS {1e3 * row['rms_m']:.2f} mm; "
            f"about {left_min:.0f} min left"
        )

    try:
        for seed in range(args.first, args.first + args.seeds):
            for kind in kinds:
                rows += run_kind(kind, seed, args, len(rows), show_row)
    except KeyboardInterrupt:
        print("interrupted; of the runs so far:", file=sys.stderr)
    if args.json:
        print(json.dumps({"machine": machine(), "rows": rows}))
        return
    print_rows(rows)


COLUMNS = (  # heading, key, factor, 1: the largest is the worst, -1: the least
    ("RMS mm", "rms_m", 1e3, 1),
    ("P99 mm", "p99_m", 1e3, 1),
    ("least mm", "clearance_min_m", 1e3, -1),
    ("inside %", "violations", 1e2, 1),
    ("contact %", "contacts", 1e2, 1),
    ("tip m/s²", "tip_acceleration_rms_mps2", 1.0, 1),
    ("noticed", "inside_times", 1.0, 1),
    ("later %", "inside_later_part", 1e2, 1),
    ("run s", "duration_s", 1.0, 1),
    ("held", "held_ticks", 1.0, 1),
)


def print_rows(rows: list[dict[str, Any]]) -> None:
    """Median and worst of the seeds, for each map and way."""
    print(f"{'map':<16}{'way':<20}{'ended':>8}" + "".join(f"{name:>15}" for name, *_ in COLUMNS))
    for kind, way in dict.fromkeys((r["map"], r["way"]) for r in rows):
        of = [r for r in rows if (r["map"], r["way"]) == (kind, way)]
        text = f"{kind:<16}{way:<20}{sum(r['finished'] for r in of):>5}/{len(of):<2}"
        for _, key, factor, sign in COLUMNS:
            values = [factor * r[key] for r in of if r.get(key) is not None]
            if not values:
                text += f"{'-':>15}"
                continue
            text += f"{f'{np.median(values):.2f}, {sign * max(sign * v for v in values):.2f}':>15}"
        print(text)


def run_kind(
    kind: str, seed: int, args: argparse.Namespace, before: int, show_row: Callable[[dict[str, Any]], None]
) -> list[dict[str, Any]]:
    """All ways over one wrong map, with one service; `before`: number of runs before these."""
    speed_mps, ways, mode_hz, limit = (
        args.speed,
        args.ways.split(","),
        args.mode_hz,
        args.acceleration,
    )
    true, mapped = grounds(kind, seed)
    name = f"scanrun-{os.getpid()}"
    rows = []
    with tempfile.TemporaryDirectory(prefix="surffollow-scanrun-") as temporary, no_leftovers(name):
        folder = Path(temporary)
        HeightMap.from_heights(true, origin_m=FIELD[:2], grid_m=GRID_M).save(folder / "true.npz")
        HeightMap.from_heights(mapped, origin_m=FIELD[:2], grid_m=GRID_M).save(folder / "map.npz")
        field = HeightField(
            np.ascontiguousarray(true), FIELD[0] + 0.5 * GRID_M, FIELD[1] + 0.5 * GRID_M, GRID_M
        )
        settings = PlanSettings(
            region=REGION,
            gap_m=GAP_M,
            body_m=disc(RADIUS_M),
            shaper=Shaper.zvd(args.lateral_hz, LATERAL_DAMPING) if args.lateral_hz > 0.0 else None,
            motion=MotionLimits(speed_mps=speed_mps, acceleration_mps2=limit, lateral_mps2=limit),
        )
        grid = TerrainGrid.of(mapped, origin_m=FIELD[:2], grid_m=GRID_M)
        plan = plan_scan(grid, settings)
        (folder / "s.toml").write_text(CONFIG.format(file=folder / "true.npz", offset=GAP_M))
        words = ["start", "--name", name, "--config", str(folder / "s.toml")]
        with running("service", words, folder) as service:
            _await_ready(service, name, lambda _text, _part: None)
            for way in ways:
                used, installed, shaped = WAYS[way]

                def prepare(client: Any, install: bool = installed) -> None:
                    client.map_reset(FIELD)
                    if install:
                        client.map_install(folder / "map.npz")

                shaper = Shaper.zvd(mode_hz, DAMPING) if shaped else None
                config = ScanRobotConfig(way=used, shaper=shaper, seed=seed)
                done = execute(
                    plan, name, lambda: attach(name, label="scan"), config, ground=grid, prepare=prepare
                )
                row = {"map": kind, "way": way, "seed": seed, "speed_mps": speed_mps, "mode_hz": mode_hz}
                row["number"] = before + len(rows) + 1
                rows.append(done.summary | row | true_figures(done, field) | sensed_figures(done))
                show_row(rows[-1])
    return rows


if __name__ == "__main__":
    main()
