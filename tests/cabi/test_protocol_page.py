"""The reference says what the layout is."""

from __future__ import annotations

import subprocess
import sys

from cabi.running import ROOT
from surffollow.client.demand import STALE
from surffollow.shm.layout_follow import STATUS_NAMES


def test_byte_tables_are_current() -> None:
    command = [sys.executable, str(ROOT / "tools/protocol_tables.py"), "--check"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr + "; run tools/protocol_tables.py"


def test_status_bits_of_the_text_are_those_of_the_code() -> None:
    text = " ".join((ROOT / "docs/reference/health-and-faults.md").read_text().split())
    for bit, name in [*enumerate(STATUS_NAMES), (STALE.bit_length() - 1, "STALE")]:
        assert f"| {bit} | {name} |" in text, name
