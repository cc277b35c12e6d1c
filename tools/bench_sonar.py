"""Bench wall poses from sonars: accuracy, moves against exhaustive search, time per call.

    python tools/bench_sonar.py [--json] [--seed N] [--rooms N]

Ranges come from the forward model of docs/explanation/wall-pose.md. The real log is used where it is present
(SURFFOLLOW_DATA).
"""

from __future__ import annotations

import argparse
import copy
import math
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from report import criterion, finish, result
from surffollow.sonar import fused_pose, wall_pose, walls
from surffollow.sonar.beam import predict_ranges
from surffollow.sonar.belief import Belief
from surffollow.sonar.ring import SonarRing
from surffollow.sonar.strategy import candidate_moves, next_reading

ALPHA = math.radians(11.25)
ROOM_M = (6.0, 4.0)
BOUNDS = {"phi_bound_rad": math.radians(1.2), "distance_bound_m": 0.04}
LOG = Path(os.environ.get("SURFFOLLOW_DATA", Path(__file__).parents[1] / "../shared/data"))
Array = NDArray[np.float64]


def turned(angle_rad: float) -> float:
    """An angle in [−π, π]."""
    return math.remainder(angle_rad, 2.0 * math.pi)


def ranges_of(ring: SonarRing, pose: tuple[float, float, float], room: Array) -> Array:
    """Ranges of a ring without noise; inf beyond its maximum."""
    positions, headings = ring.at(pose)
    out = np.empty(headings.size)
    predict_ranges(positions, headings, ring.half_beam_rad, ring.max_incidence_rad, room, out)
    return np.where(out > ring.max_range_m, math.inf, out)


def noisy(ring: SonarRing, pose: tuple[float, float, float], room: Array, rng: np.random.Generator) -> Array:
    """Ranges of a ring with its noise."""
    return ranges_of(ring, pose, room) * (
        1.0 + ring.range_sigma * rng.standard_normal(ring.headings_rad.size)
    )


def room_around(rng: np.random.Generator) -> Array:
    """The walls (φ, d) of a 6 × 4 m room around a random pose."""
    x, y = rng.uniform(0.6, ROOM_M[0] - 0.6), rng.uniform(0.6, ROOM_M[1] - 0.6)
    h = rng.uniform(-math.pi, math.pi)
    return np.array(
        [(-h, ROOM_M[0] - x), (math.pi / 2 - h, ROOM_M[1] - y), (math.pi - h, x), (-math.pi / 2 - h, y)]
    )


def exact_pairs(seed: int, n: int) -> tuple[float, int, int]:
    """Largest error without noise, walls missed, ambiguous pairs over n random geometries."""
    rng, worst, missed, ambiguous = np.random.default_rng(seed), 0.0, 0, 0
    while n > 0:
        half_beam = math.radians(rng.choice([11.25, 22.5]))
        limit = half_beam + rng.choice([0.0, 0.5 * math.pi])
        t = rng.uniform(-math.pi, math.pi) + np.array([0.0, rng.uniform(-1.2, 1.2) * min(limit, 1.0)])
        p = rng.uniform(0.1, 0.5) * np.column_stack([np.cos(t), np.sin(t)]) + rng.uniform(-0.1, 0.1, (2, 2))
        wall, r = np.array([[rng.uniform(-math.pi, math.pi), rng.uniform(0.8, 4.0)]]), np.empty(2)
        predict_ranges(p, t, half_beam, limit, wall, r)
        if not (r < 50.0).all():
            continue
        n -= 1
        found = wall_pose(p, t, r, half_beam, max_incidence_rad=limit)
        errors = [max(abs(turned(w.phi_rad - wall[0, 0])), abs(w.distance_m - wall[0, 1])) for w in found]
        best = min(errors, default=math.inf)
        missed += best > 1e-6
        worst = max(worst, best)
        ambiguous += len(found) > 1
    return worst, missed, ambiguous


def covariance_ratio(seed: int) -> float:
    """Largest deviation of a predicted standard deviation from 8,000 draws, over four pairs of sonars."""
    rng, sigma, worst = np.random.default_rng(seed), 1e-4, 0.0
    scenes = [((0.0, 15.0), 40.0), ((0.0, 30.0), 50.0), ((-15.0, 15.0), 60.0), ((0.0, 45.0), -30.0)]
    for degrees, phi_deg in scenes:
        t, phi = np.radians(degrees), math.radians(phi_deg)
        p, r = 0.35 * np.column_stack([np.cos(t), np.sin(t)]), np.empty(2)
        limit = ALPHA + 0.5 * math.pi
        predict_ranges(p, t, ALPHA, limit, np.array([[phi, 1.0]]), r)

        def nearest(ranges: Array) -> Any:
            found = wall_pose(p, t, ranges, ALPHA, model="diffuse", sigma_m=sigma)  # noqa: B023
            return min(found, key=lambda w: abs(turned(w.phi_rad - phi)))  # noqa: B023

        reported = nearest(r)
        draws = [nearest(r + sigma * rng.standard_normal(2)) for _ in range(8000)]
        spread = np.std([(turned(w.phi_rad - phi), w.distance_m) for w in draws], axis=0)
        worst = max(
            worst, abs(reported.phi_std_rad / spread[0] - 1.0), abs(reported.distance_std_m / spread[1] - 1.0)
        )
    return worst


def fused_rms(seed: int, model: str, n: int) -> tuple[float, float]:
    """RMS error of fused poses [degrees, mm], 1 % noise, at least two echoes, walls 0.8-2.5 m away."""
    rng, ring, errors = np.random.default_rng(seed), SonarRing.regular(model=model), []
    while len(errors) < n:
        wall = np.array([[rng.uniform(-math.pi, math.pi), rng.uniform(0.8, 2.5)]])
        r = noisy(ring, (0.0, 0.0, 0.0), wall, rng)
        if np.isfinite(r).sum() < 2:
            continue
        got = fused_pose(
            ring.positions_m, ring.headings_rad, r, ALPHA, sigma_m=ring.sigmas(r), model=model,
            max_range_m=ring.max_range_m,
        )  # fmt: skip
        assert got is not None
        errors.append((turned(got.phi_rad - wall[0, 0]), got.distance_m - wall[0, 1]))
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    return math.degrees(rms[0]), 1e3 * float(rms[1])


def rooms_found(seed: int, n: int) -> tuple[int, float, float]:
    """Rooms with all four walls found, RMS of φ [degrees] and d [mm]; δ_max 30°, 1 % noise."""
    rng, ring = np.random.default_rng(seed), SonarRing.regular(max_incidence_rad=math.radians(30))
    whole, errors = 0, []
    for _ in range(n):
        room = room_around(rng)
        r = noisy(ring, (0.0, 0.0, 0.0), room, rng)
        found = walls(
            ring.positions_m, ring.headings_rad, r, ALPHA, 4, sigma_m=ring.sigmas(r),
            max_incidence_rad=ring.max_incidence_rad, max_range_m=ring.max_range_m,
        )  # fmt: skip
        mine = []
        for phi, d in room:
            near = [(turned(w.phi_rad - phi), w.distance_m - d) for w in found]
            mine += [e for e in near if abs(e[0]) < math.radians(10) and abs(e[1]) < 0.2][:1]
        whole += len(mine) == 4
        errors += mine
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    return whole, math.degrees(rms[0]), 1e3 * float(rms[1])


def diffuse_rooms(seed: int, n: int) -> tuple[int, int, float, float]:
    """Walls of rooms with four or more own echoes in the diffuse model, 1 % noise.

    Returns
    -------
    int, int, float, float
        Such walls not found; found walls beyond five standard deviations of every true one; RMS of φ
        [degrees]; mean normalised squared error over 2 (1 where the covariance is true)
    """
    rng, ring = np.random.default_rng(seed), SonarRing.regular(model="diffuse")
    missed, strange, errors, normalised = 0, 0, [], []
    for _ in range(n):
        room = room_around(rng)
        source = np.argmin([ranges_of(ring, (0.0, 0.0, 0.0), wall[None]) for wall in room], axis=0)
        r = noisy(ring, (0.0, 0.0, 0.0), room, rng)
        found = walls(
            ring.positions_m, ring.headings_rad, r, ALPHA, 4, sigma_m=ring.sigmas(r), model="diffuse",
            max_range_m=ring.max_range_m,
        )  # fmt: skip

        def off(w: Any, wall: Array) -> float:
            e = np.array([turned(w.phi_rad - wall[0]), w.distance_m - wall[1]])
            return float(e @ np.linalg.solve(w.covariance, e))

        strange += sum(min(off(w, wall) for wall in room) > 25.0 for w in found)
        for k, wall in enumerate(room):
            if (source == k).sum() < 4:
                continue
            near = [
                w
                for w in found
                if abs(turned(w.phi_rad - wall[0])) < 0.2 and abs(w.distance_m - wall[1]) < 0.3
            ]
            missed += not near
            errors += [turned(w.phi_rad - wall[0]) for w in near[:1]]
            normalised += [off(w, wall) for w in near[:1]]
    return (
        missed,
        strange,
        math.degrees(np.sqrt(np.mean(np.square(errors)))),
        float(np.mean(normalised)) / 2.0,
    )


def moves_needed(seed: int, most: int = 3) -> tuple[int, int]:
    """Moves of `next_reading` and of an exhaustive search over the same moves, in one room."""
    ring = SonarRing.regular()
    rng = np.random.default_rng(seed)
    room, noise = room_around(rng), int(rng.integers(1 << 30))

    def after(belief: Belief, turn: float, drive: float) -> Belief:
        # the noise of a reading depends on the pose alone, so that both ways see the same readings
        new = copy.deepcopy(belief)
        new.move(turn, drive)
        key = [noise, *(round(1e6 * v) & 0xFFFFFFFF for v in new.pose)]
        new.add(noisy(ring, new.pose, room, np.random.default_rng(key)))
        return new

    start = after(Belief(ring, 4, **BOUNDS), 0.0, 0.0)
    ours, belief = 0, start
    while not belief.settled and ours < 8:
        plan = next_reading(belief)
        assert plan is not None
        belief, ours = after(belief, plan.turn_rad, plan.drive_m), ours + 1
    level, moves = [start], 0
    while not any(b.settled for b in level) and moves < most:
        level, moves = [after(b, *m) for b in level for m in candidate_moves(b)], moves + 1
    return ours, moves


def real_log() -> list[float] | None:
    """Median error [m] of US18, US19, US20 predicted by the wall that the other four of US17-21 fit."""
    path = LOG / "scitos_wall/scitos24_first_half.npz"
    if not path.exists():
        return None
    log = np.load(path)
    t, ranges = np.radians(log["angle_deg"].astype(float)), log["range_m"].astype(float)
    p, limit, medians = 0.2 * np.column_stack([np.cos(t), np.sin(t)]), math.radians(30), []
    for held_out in (17, 18, 19):
        others, errors = [s for s in range(16, 21) if s != held_out], []
        for row in ranges:
            r = np.where(row[others] >= 4.99, math.inf, row[others])
            sigma = 0.05 * np.where(np.isfinite(r), np.maximum(r, 0.3), 5.0)
            found = walls(
                p[others], t[others], r, ALPHA, 1, min_sensors=1, max_range_m=5.0, sigma_m=sigma,
                max_incidence_rad=limit,
            )  # fmt: skip
            reported = np.full(1, math.inf)
            if found:
                wall = np.array([[found[0].phi_rad, found[0].distance_m]])
                predict_ranges(p[[held_out]], t[[held_out]], ALPHA, limit, wall, reported)
            errors.append(abs(min(5.0, reported[0]) - row[held_out]))
        medians.append(float(np.median(errors)))
    return medians


def call_ms(k: int, model: str | None, n: int = 100) -> tuple[float, float]:
    """Processor time of one call with 24 sonars [ms], median and longest over n rounds.

    One wall, or the four of a room. Each round counts with the median of five calls.
    """
    rng = np.random.default_rng(1)
    limit = None if model else math.radians(30)
    ring = SonarRing.regular(model=model or "specular", max_incidence_rad=limit)
    rounds = []
    for _ in range(n):
        room = np.array([(0.3, 1.5)]) if k == 1 else room_around(rng)
        r, taken = noisy(ring, (0.0, 0.0, 0.0), room, rng), []
        for _ in range(5):
            begun = time.process_time()
            walls(
                ring.positions_m, ring.headings_rad, r, ALPHA, k, sigma_m=ring.sigmas(r), min_sensors=1,
                max_incidence_rad=ring.max_incidence_rad, max_range_m=ring.max_range_m,
            )  # fmt: skip
            taken.append(1e3 * (time.process_time() - begun))
        rounds.append(float(np.median(taken)))
    return float(np.median(rounds)), max(rounds)


def main() -> dict[str, Any]:
    """Run everything."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--json", action="store_true")
    words.add_argument("--seed", type=int, default=1000)
    words.add_argument("--rooms", type=int, default=200, help="rooms for the comparison of moves")
    asked = words.parse_args()
    worst, missed, ambiguous = exact_pairs(asked.seed, 12_000)
    specular, diffuse = fused_rms(asked.seed, "specular", 2000), fused_rms(asked.seed, "diffuse", 2000)
    whole, room_deg, room_mm = rooms_found(asked.seed, 500)
    missed, strange, diffuse_deg, normalised = diffuse_rooms(asked.seed, 200)
    moves = [moves_needed(asked.seed + k) for k in range(asked.rooms)]
    log = real_log()
    absent = "" if log else "the real log is not on this machine"
    criteria = [
        criterion("largest error without noise, 12,000 pairs", worst, 1e-9, "rad or m"),
        criterion("walls missed without noise", missed, 0, "", f"{ambiguous} pairs are ambiguous and say so"),
        criterion("covariance against 8,000 draws", covariance_ratio(asked.seed), 0.05, ""),
        criterion("fused, specular, φ RMS", specular[0], 2.1, "deg", "two beams allow 7.5°/√12 = 2.17°"),
        criterion("fused, specular, d RMS", specular[1], 12.0, "mm"),
        criterion("fused, diffuse, φ RMS", diffuse[0], 0.14, "deg"),
        criterion("fused, diffuse, d RMS", diffuse[1], 5.7, "mm"),
        criterion("rooms without all four walls, of 500", 500 - whole, 0, ""),
        criterion("room, φ RMS", room_deg, 1.5, "deg"),
        criterion("room, d RMS", room_mm, 13.5, "mm"),
        criterion("moves beyond exhaustive search, worst", max(a - b for a, b in moves), 1, "",
            f"{asked.rooms} rooms, mean {np.mean([a for a, _ in moves]):.2f} against "
            f"{np.mean([b for _, b in moves]):.2f}"),
        *(
            criterion(
                f"real log, US{18 + k}, median error", None if log is None else log[k], limit, "m", absent
            )
            for k, limit in enumerate((0.042, 0.042, 0.092))
        ),
        criterion("diffuse room, walls of four or more echoes missed", missed, 0, "",
            f"of 200 rooms; {strange} walls found lie beyond five standard deviations of every true one"),
        criterion("diffuse room, φ RMS", diffuse_deg, 1.5, "deg", "walls of four or more echoes"),
        criterion("diffuse room, normalised squared error / 2", normalised, 1.5, "", "1: true covariance"),
        *(
            criterion(f"24 sonars, {what}", median, limit_ms, "ms", f"processor time; max {longest:.2f} ms")
            for what, limit_ms, (median, longest) in (
                ("one wall, diffuse", 1.0, call_ms(1, "diffuse")),
                ("one wall, specular", 1.0, call_ms(1, "specular")),
                ("four walls, 30°", 5.0, call_ms(4, None)),
                ("four walls, diffuse", 5.0, call_ms(4, "diffuse")),
                ("four walls, specular", 5.0, call_ms(4, "specular")),
            )
        ),
    ]  # fmt: skip
    return result("wall poses from sonars", criteria, [], seed=asked.seed)


if __name__ == "__main__":
    sys.exit(finish(main()))
