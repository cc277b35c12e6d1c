"""Time the offline replay: cycles per second on one core, reading, checking and comparing included.

Records a synthetic log (the same kernels and log as the service, invented inputs), then
replays the file several times in this process, after one replay that is not counted.
Wall time and processor time are given. The criterion is of one core, so it is judged by
processor time: wall time on a busy machine measures the neighbours. (The file lies in
the page cache; a slow disk shows in wall time only.)

    python tools/bench_replay.py [--cycles 500000] [--channels 1] [--mode paper] [--json]
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numba
import numpy as np

from surffollow.record.recorder import Recorder
from surffollow.record.recording_writer import RecordingWriter
from surffollow.record.replay import replay_file
from surffollow.record.synthetic_log import SyntheticLog

LIMIT_CYCLES_PER_S = 1e6
CONVERSIONS_PER_CYCLE = 25  # 25 kHz converter, 1 kHz cycle
MODES = {"paper": 0, "adaptive": 1}


def make_file(path: Path, cycles: int, mode: str, channels: int) -> float:
    """Record a synthetic log; cycles per second of recording (without the making of the log)."""
    synthetic_log = SyntheticLog(mode=MODES[mode], channels=channels, conversions=CONVERSIONS_PER_CYCLE)
    recorder = Recorder(synthetic_log, RecordingWriter(path, {"name": "bench"}))
    spent = 0.0
    for _ in range(0, cycles, 1000):
        synthetic_log.run(1000)
        begin = time.process_time()
        recorder.poll()
        spent += time.process_time() - begin
    recorder.finish()
    return cycles / spent


def measure(cycles: int, mode: str, channels: int, repeats: int) -> dict[str, Any]:
    """All figures of one setting."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.mcap"
        recording = make_file(path, cycles, mode, channels)
        first = replay_file(path)
        wall, processor = [], []
        for _ in range(repeats):
            begin = time.process_time()
            report = replay_file(path)
            processor.append(cycles / (time.process_time() - begin))
            wall.append(report.cycles_per_s)
        return {
            "mode": mode,
            "channels": channels,
            "cycles": first.cycles,
            "identical": first.identical,
            "bytes_per_cycle": path.stat().st_size / cycles,
            "recorded_cycles_per_processor_s": recording,
            "replayed_cycles_per_s": {
                "median": float(np.median(wall)),
                "best": max(wall),
                "worst": min(wall),
            },
            "replayed_cycles_per_processor_s": float(np.median(processor)),
        }


def main() -> int:
    """Measure and print; 1 when the criterion is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--cycles", type=int, default=500_000)
    parser.add_argument("--channels", type=int, default=1)
    parser.add_argument("--mode", choices=list(MODES), default="paper")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--json", action="store_true")
    o = parser.parse_args()
    cycles = max(1, o.cycles // 1000) * 1000
    result = measure(cycles, o.mode, o.channels, o.repeats)
    result |= {"machine": platform.machine(), "python": platform.python_version(), "numba": numba.__version__}
    reached = result["replayed_cycles_per_processor_s"]
    result["limit_cycles_per_s"], result["limit_met"] = (
        LIMIT_CYCLES_PER_S,
        bool(reached >= LIMIT_CYCLES_PER_S),
    )
    if o.json:
        print(json.dumps(result))
    else:
        m = {key: value / 1e6 for key, value in result["replayed_cycles_per_s"].items()}
        per_processor = result["replayed_cycles_per_processor_s"] / 1e6
        recording = result["recorded_cycles_per_processor_s"] / 1e6
        print(
            f"replay, {o.mode} mode, {o.channels} channel(s), {result['bytes_per_cycle']:.0f} bytes/cycle: "
            f"{m['median']:.2f} M cycles/s median, {m['best']:.2f} best, {m['worst']:.2f} worst "
            f"of {o.repeats}; {per_processor:.2f} M per processor second\n"
            f"recording: {recording:.2f} M cycles per processor second\n"
            f"identical: {result['identical']}; criterion {LIMIT_CYCLES_PER_S / 1e6:g} M cycles/s: "
            f"{'met' if result['limit_met'] else 'MISSED'}"
        )
    return 0 if result["limit_met"] and result["identical"] else 1


if __name__ == "__main__":
    sys.exit(main())
