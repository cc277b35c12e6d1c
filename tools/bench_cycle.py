"""Time the kernels of one cycle beside plain C in the same run: 8 channels, 8 map updates, paper mode.

Timed: a batch of cycles, each `follow_step` with 25 conversions over 8 channels and a new pose
every tenth cycle, then `update_map` for each fresh target point. Batches of both alternate; the time of a
cycle is a batch's time over its cycles, p50/p99/max are over batches. Results (outputs, state, map) are
compared bit for bit after the run.
"""

from __future__ import annotations

import ctypes
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba import njit

from report import criterion, finish, machine
from surffollow.config.params import PARAMS
from surffollow.forecast.step import follow_step
from surffollow.map.header import init_header
from surffollow.map.kernels.geometry import reset_begin, reset_step
from surffollow.map.kernels.grids import update_map
from surffollow.service import memory as m
from surffollow.service.range_inputs import any_held, drain_ranges, drop_dead_range_holders
from surffollow.shm import map_layout as ml
from surffollow.shm.conversion import pack_conversion
from surffollow.shm.dtypes import numpy_dtype, zeros
from surffollow.shm.layout_follow import FollowState, Inputs, Output, Params
from surffollow.shm.schema import SCALARS, Schema

CYCLES, BATCHES = 2000, 300
SKIP = 12  # the first batches compile, load and touch the pages
LIMIT_NS, LIMIT_RATIO, LIMIT_UNUSED_NS = 1000.0, 1.3, 10.0
PERIOD_NS = 1_000_000


# not cached: a cache entry would keep old kernels inlined when only their files change
@njit(nogil=True)
def run_batch(
    params: Any, state: Any, inputs: Any, output: Any, scratch: Any, header: Any, pairs: Any
) -> Any:
    """Every cycle of `inputs`, with its map updates; the number of updates that changed a grid."""
    changed = 0
    for k in range(inputs.size):
        follow_step(params, state, inputs[k : k + 1], output, scratch)
        o = output[0]
        for c in range(8):
            if (o.fresh >> c) & 1:
                x, y, z = o.target_m[3 * c], o.target_m[3 * c + 1], o.target_m[3 * c + 2]
                if update_map(header, pairs, x, y, z) == 0:
                    changed += 1
    return changed


def c_struct(schema: type[Schema], name: str) -> str:
    """A C structure with the schema's offsets, asserted."""
    lines = [f"typedef struct {{ // {schema.__name__}"]
    at, pads = 0, 0
    asserts = []
    for f in schema.FIELDS:
        if f.offset > at:
            lines.append(f"  uint8_t pad{pads}[{f.offset - at}];")
            pads += 1
        kind = f.nested.__name__ if f.nested else "char" if f.is_text else SCALARS[f.code][2]
        lines.append(f"  {kind} {f.name}{f'[{f.count}]' if f.count > 1 else ''};")
        asserts.append(f'_Static_assert(offsetof({name}, {f.name}) == {f.offset}, "{f.name}");')
        at = f.offset + f.size
    lines.append(f"}} {name};")
    asserts.append(f'_Static_assert(sizeof({name}) == {schema.SIZE}, "size");')
    return "\n".join([*lines, *asserts])


def c_header() -> str:
    """Every structure that the twin uses, from the one declaration."""
    done: list[type[Schema]] = []

    def add(schema: type[Schema]) -> None:
        for f in schema.FIELDS:
            if f.nested and f.nested not in done:
                add(f.nested)
        if schema not in done:
            done.append(schema)

    for s in (Params, FollowState, Inputs, Output, ml.MapHeader, ml.GridPair):
        add(s)
    body = "\n".join(c_struct(s, s.__name__) for s in done)
    return f"#include <stddef.h>\n#include <stdint.h>\n{body}\n"


def build_twin(folder: Path) -> Any:
    """Compile tools/cycle_twin.c with -O3; contraction off, for the bits are compared."""
    (folder / "layout.h").write_text(c_header())
    library = folder / "cycle_twin.so"
    source = Path(__file__).with_name("cycle_twin.c")
    line = ["cc", "-O3", "-std=c11", "-Wall", "-Wextra", "-ffp-contract=off", "-shared", "-fPIC"]
    subprocess.run([*line, f"-I{folder}", "-o", str(library), str(source), "-lm"], check=True)
    twin = ctypes.CDLL(str(library)).run_batch
    twin.restype = ctypes.c_int64
    return twin


def make_inputs(seed: int, cycles: int, start_ns: int) -> Any:
    """8 channels, 25 conversions a cycle, a pose every tenth cycle, rough ground, 1 % drop-outs."""
    rng = np.random.default_rng(seed)
    inputs = zeros(Inputs, cycles)
    height = 0.1 + np.cumsum(rng.normal(0.0, 2e-5, cycles))
    for k in range(cycles):
        i = inputs[k]
        t_ns = start_ns + k * PERIOD_NS
        i["t_ns"] = t_ns
        if k % 10 == 0:
            i["n_poses"] = 1
            i["pose_t_ns"][0] = t_ns - 3_000_000
            x = 0.05 * k * 1e-3
            i["pose"][:7] = (x, 0.01 * np.sin(x * 50.0), 0.2, 0.0, 0.0, 0.0, 1.0)
        i["n_conversions"] = 25
        for n in range(25):
            counts = int((height[k] - 0.0508) / (0.1016 / 4095) + rng.normal(0.0, 3.0))
            counts = 0 if rng.random() < 0.01 / 25 else counts
            i["conversion"][n] = pack_conversion(counts, (25 * k + n) % 8, 0, -PERIOD_NS + 40_000 * (n + 1))
    return inputs


class Side:
    """Memory of one of the two."""

    def __init__(self) -> None:
        self.params, self.state = zeros(Params), zeros(FollowState)
        p = self.params[0]
        for name, spec in PARAMS.items():
            p[name] = spec.default
        p["mode"], p["n_channels"], p["sensor_readings"] = 0, 8, 3  # the paper
        p["scale_m"], p["zero_m"] = 0.1016 / 4095, 0.0508
        mounts = p["tool_from_sensor"].reshape(8, 7)
        mounts[:, 6] = 1.0
        mounts[:, 0] = 0.01 * np.arange(8)
        self.output, self.scratch = zeros(Output), np.zeros(7)
        self.header = zeros(ml.MapHeader)
        self.pairs = np.zeros(500_000, numpy_dtype(ml.GridPair))
        init_header(self.header, capacity_grids=1_000_000)
        reset_begin(self.header, -1.0, -1.0, 1.0, 1.0)
        while reset_step(self.header, self.pairs, 1 << 20) == 0:
            pass

    def arrays(self, inputs: Any) -> tuple[Any, ...]:
        return self.params, self.state, inputs, self.output, self.scratch, self.header, self.pairs

    def differences(self, other: Side) -> list[str]:
        """Parts that differ in a bit."""
        names = ("params", "state", "output", "header", "pairs")
        return [n for n in names if getattr(self, n).tobytes() != getattr(other, n).tobytes()]


def measure(batches: int = BATCHES, cycles: int = CYCLES) -> dict[str, Any]:
    """Alternate batches of both; times per cycle [ns]."""
    kernel, plain = Side(), Side()
    seconds: dict[str, list[float]] = {"kernel": [], "c": []}
    with tempfile.TemporaryDirectory() as folder:
        twin = build_twin(Path(folder))
        blocks = [make_inputs(91 + b, cycles, 0) for b in range(4)]
        updates = {"kernel": 0, "c": 0}
        for b in range(batches):
            inputs = blocks[b % len(blocks)]
            shift = 1_000_000_000 + b * cycles * PERIOD_NS
            inputs["t_ns"] += shift
            inputs["pose_t_ns"][:, 0] += shift
            arrays = plain.arrays(inputs)
            pointers = [a.ctypes.data_as(ctypes.c_void_p) for a in arrays]
            for side in ("kernel", "c") if b % 2 else ("c", "kernel"):
                start = time.perf_counter_ns()
                if side == "kernel":
                    updates[side] += run_batch(*kernel.arrays(inputs))
                else:
                    updates[side] += twin(*pointers, ctypes.c_int64(cycles))
                seconds[side].append((time.perf_counter_ns() - start) / cycles)
            inputs["t_ns"] -= shift
            inputs["pose_t_ns"][:, 0] -= shift
    out: dict[str, Any] = {"updates_per_cycle": updates["kernel"] / (batches * cycles)}
    for side, values in seconds.items():
        kept = values[SKIP:]
        out[side] = {f"p{q}_ns": float(np.percentile(kept, q)) for q in (50, 99)} | {"max_ns": max(kept)}
    ratios = np.array(seconds["kernel"][SKIP:]) / np.array(seconds["c"][SKIP:])
    out["ratio"] = float(np.median(ratios))
    out["differences"] = kernel.differences(plain)
    return out


@njit(nogil=True)
def look_for_ranges(mem: Any, cycles: Any) -> Any:
    """Work of every service's cycle for pushed ranges; the sum keeps the compiler from removing it."""
    for k in range(cycles):
        if any_held(mem.ctx):
            drop_dead_range_holders(mem, k)
        if any_held(mem.ctx):
            drain_ranges(mem, k)
        mem.entry[0] += mem.ctx[m.RANGES_HELD]
    return mem.entry[0]


def unused_ring_ns() -> float:
    """Time per cycle [ns] that a service spends on pushed ranges when no client pushes any."""
    mem, best = m.make_cycle_memory(), float("inf")
    look_for_ranges(mem, 1)
    for _ in range(20):
        start = time.perf_counter_ns()
        look_for_ranges(mem, 1_000_000)
        best = min(best, (time.perf_counter_ns() - start) / 1e6)
    return best


def main() -> dict[str, Any]:
    """Measure and hold against the criteria."""
    got = measure()
    compiler = subprocess.run(["cc", "--version"], capture_output=True, text=True).stdout.split("\n")[0]
    c, k = got["c"], got["kernel"]
    return {
        "what": "one cycle: follow_step with 8 channels and 8 update_map, paper mode, beside plain C",
        "machine": machine(f"numba {numba.__version__}", compiler),
        **got,
        "criteria": [
            criterion("cycle p50", k["p50_ns"], LIMIT_NS, "ns"),
            criterion("cycle / cc -O3", got["ratio"], LIMIT_RATIO, "", "median over pairs of batches"),
            criterion("look for pushed ranges, none held", unused_ring_ns(), LIMIT_UNUSED_NS, "ns"),
            criterion("parts that differ from the C twin", len(got["differences"]), 0, "", "bit for bit"),
        ],
        "notes": [
            f"{name:<8} p50 {t['p50_ns']:.0f} ns, p99 {t['p99_ns']:.0f} ns, max {t['max_ns']:.0f} ns"
            for name, t in (("kernels", k), ("C", c))
        ],
    }


if __name__ == "__main__":
    sys.exit(finish(main()))
