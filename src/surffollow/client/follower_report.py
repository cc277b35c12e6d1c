"""The follower's estimates and the faults that are latched, in words and SI numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from surffollow.shm.bit_names import FIRST_SERVICE_FAULT, SERVICE_FAULT_NAMES
from surffollow.shm.layout_adaptive import FAULT_NAMES, HEALTH_NAMES, reason_text
from surffollow.shm.layout_follow import MODE_ADAPTIVE

_ESTIMATES = ("height_m", "slope", "speed_mps", "error_m")
_ADAPTED = (
    "sigma_m",
    "noise_m",
    "roughness_m",
    "late_s",
    "latency_s",
    "permitted_variance_m",
    "interval_size_m",
    "range_size",
    "tau_s",
)


def numbered_faults(follower_bits: int, service_bits: int) -> list[dict[str, Any]]:
    """Latched faults as `{"number", "name"}`, the follower's from 1, the service's from 33."""
    found = [(n + 1, name) for n, name in enumerate(FAULT_NAMES) if follower_bits >> n & 1]
    found += [
        (FIRST_SERVICE_FAULT + n, name) for n, name in enumerate(SERVICE_FAULT_NAMES) if service_bits >> n & 1
    ]
    return [{"number": number, "name": name} for number, name in found]


def follower_report(output: Mapping[str, Any] | None, mode: int) -> dict[str, Any]:
    """Estimates of the follower, and in adaptive mode health and what it adapted.

    Parameters
    ----------
    output : the board's `Output`, or None when it cannot be read
    mode : of the parameters in force
    """
    facts: dict[str, Any] = {"mode": "adaptive" if mode == MODE_ADAPTIVE else "paper"}
    if output is None:
        return facts
    names: tuple[str, ...] = _ESTIMATES
    if mode == MODE_ADAPTIVE:
        facts["health"] = HEALTH_NAMES[output["health"]] if 0 <= output["health"] < len(HEALTH_NAMES) else "?"
        facts["reason"] = reason_text(output["reason"])
        names += _ADAPTED
    for name in names:
        value = output[name]
        facts[name] = value if math.isfinite(value) else None
    normal = list(output["normal"])
    if mode == MODE_ADAPTIVE and any(normal):
        facts["normal"] = normal
        facts["beams"] = [c for c in range(8) if output["beams"] >> c & 1]
    return facts
