"""A finding of the check of a path file."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """One requirement: whether it is met, and the figure behind it."""

    name: str
    ok: bool
    text: str
    value: float | None = None
