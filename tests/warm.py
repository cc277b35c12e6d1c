"""Start a service once, alone: it compiles on both processors what the tests' workers then load."""

from __future__ import annotations

import tempfile
from pathlib import Path

from running_service import Service, config_text

if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        service = Service(Path(folder), config_text(kind="simulated"))
        try:
            service.start().terminate()
        finally:
            service.purge()
