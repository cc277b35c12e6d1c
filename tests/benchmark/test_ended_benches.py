"""A bench that is ended by a signal ends its service, and removes what that had."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from running_service import config_text, objects_of, unique_name

TOOLS = Path(__file__).resolve().parents[2] / "tools"
BENCH = """
import signal, sys
from pathlib import Path
from service_process import service_process
with service_process(sys.argv[1], Path(sys.argv[2])) as service:
    print(service.pid, flush=True)
    signal.pause()
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_a_signal_ends_the_service_of_a_bench(tmp_path, number):
    config, name = tmp_path / "c.toml", unique_name()
    config.write_text(config_text())
    with subprocess.Popen(
        [sys.executable, "-c", BENCH, name, str(config)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join((str(TOOLS), os.environ.get("PYTHONPATH", "")))},
    ) as bench:
        assert bench.stdout is not None
        service = int(bench.stdout.readline())
        assert objects_of(name)
        bench.send_signal(number)
        assert bench.wait(timeout=120) != 0
    assert objects_of(name) == set()
    with pytest.raises(ProcessLookupError):
        os.kill(service, 0)
