"""Start a service and an arbiter once, alone: they compile on both processors what the tests then load."""

from __future__ import annotations

import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from arbiter.running import Running
from running_service import Service, config_text

if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor() as beside:
        service, arbiter = Service(Path(folder), config_text(kind="simulated")), Running(Path(folder))
        try:
            started = beside.submit(arbiter.start)
            service.start().terminate()
            started.result()
        finally:
            service.purge()
            arbiter.purge()
