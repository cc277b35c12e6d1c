"""Short forms of the benches that try to break the service: a scribbled inbox, kills at random moments."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

TOOLS = Path(__file__).parents[2] / "tools"


def bench(name: str, *words: str) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, str(TOOLS / name), "--json", *words], capture_output=True, text=True, timeout=400
    )
    assert done.stdout, done.stderr
    result = json.loads(done.stdout)
    missed = [b for b in result["bars"] if b["ok"] is False]
    assert (done.returncode, missed) == (0, []), result
    return result


def counts(result: dict[str, Any]) -> Counter[str]:
    """How much a run proved."""
    runs = result["runs"]
    return Counter(
        writes=runs["bytes"]["writes"],
        requests=runs["commands"]["requests"],
        checked=result["checked_against_limit"],
    )


def test_random_bytes_over_the_whole_inbox_neither_stop_nor_mislead_the_service() -> None:
    # overruns are judged by the long form on a quiet machine: here other tests run beside
    done: Counter[str] = Counter()
    for seconds in ("2", "3", "5", "10", "20"):  # until enough was written to prove something
        result = bench("bench_fuzz.py", "--seconds", seconds, "--slack", "1e5")
        assert result["works_afterwards"]
        done += counts(result)
        if min(done[k] for k in ("writes", "requests", "checked")) > 1000:
            break
    assert done["writes"] >= 1000
    assert done["requests"] > 1000
    assert done["checked"] > 1000


def test_nine_kills_of_client_recorder_and_service_heal_with_no_manual_step() -> None:
    result = bench("bench_kill.py", "--kills", "9", "--seed", "7")
    assert min(result["kills"].values()) >= 3
    assert result["known_grids"] > 10
