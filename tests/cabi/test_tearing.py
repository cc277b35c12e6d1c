"""The short form of tools/bench_tearing.py: C, C++ and Python readers at once see no torn snapshot."""

from __future__ import annotations

import json
import subprocess
import sys

from cabi.running import ROOT

TOO_FEW = (
    "reads missing to 1e7 per minute",
    "readers without an overlapped read",
    "torn ones that the control missed",
)


def test_no_reader_sees_a_torn_snapshot_though_reads_overlap_writes() -> None:
    for seconds in ("2", "10", "30"):  # until readers and writers met often enough to prove something
        command = [sys.executable, str(ROOT / "tools/bench_tearing.py"), "--seconds", seconds, "--json"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300)
        assert done.stdout, done.stderr
        found = json.loads(done.stdout)
        missed = {criterion["criterion"] for criterion in found["criteria"] if not criterion["ok"]}
        if found["compared"] > 100 and missed.isdisjoint(TOO_FEW):
            break
    for criterion in found["criteria"]:
        assert criterion["ok"], (criterion, found["notes"])
    assert set(found["daemon"]) >= {"Python"}
    assert found["compared"] > 100
