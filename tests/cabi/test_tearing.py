"""The short form of tools/bench_tearing.py: C, C++ and Python readers at once see no torn snapshot."""

from __future__ import annotations

import json
import subprocess
import sys

from cabi.running import ROOT


def test_no_reader_sees_a_torn_snapshot_though_reads_overlap_writes() -> None:
    command = [sys.executable, str(ROOT / "tools/bench_tearing.py"), "--seconds", "2", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert done.stdout, done.stderr
    found = json.loads(done.stdout)
    for bar in found["bars"]:
        assert bar["ok"], (bar, found["notes"])
    assert set(found["daemon"]) >= {"Python"}
    assert found["compared"] > 100
