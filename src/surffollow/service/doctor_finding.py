"""Result of a check of `surffollow doctor`."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

GOOD, FAIR, LACKING, UNKNOWN = "good", "fair", "lacking", "unknown"


@dataclass(frozen=True)
class Finding:
    """One check: `state` good, fair, lacking or unknown; `remedy` is empty when there is nothing to do."""

    name: str
    state: str
    found: str
    why: str
    remedy: str = ""

    def as_dict(self) -> dict[str, str]:
        return asdict(self)


def read_text(path: Path) -> str | None:
    """A small file's text; None when it cannot be read."""
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return None
