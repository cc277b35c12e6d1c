"""A finding of the check of a path file."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """One requirement: whether it is met, and the figure behind it; `warning`: met, but to be looked at."""

    name: str
    ok: bool
    text: str
    value: float | None = None
    warning: bool = False

    @property
    def mark(self) -> str:
        """Four letters before its line."""
        return "FAIL" if not self.ok else "warn" if self.warning else "ok  "
