"""Run the tests that failed beside another worker once more, alone: a fault of the code fails again.

Tests of real processes share two processors with another worker and with whatever else the machine does; a
service that stands still for a second there is the machine's doing. Both runs are printed; more than a few
failures are not repeated, they are no accident.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

MOST = 5
FAILED = Path(__file__).parents[1] / ".pytest_cache/v/cache/lastfailed"

if __name__ == "__main__":
    names = list(json.loads(FAILED.read_text())) if FAILED.exists() else []
    if not 0 < len(names) <= MOST:
        print(f"{len(names)} tests failed: not repeated", file=sys.stderr)
        sys.exit(1)
    print(f"again, alone: {' '.join(names)}", file=sys.stderr)
    sys.exit(pytest.main(["-p", "no:cacheprovider", *names]))
