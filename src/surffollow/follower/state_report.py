"""Report of a follower's state: estimates, health and adapted parameters as plain Python values."""

from __future__ import annotations

from typing import Any

from surffollow.follower.kernel_time import SHIFT_NS
from surffollow.follower.reading_stamps import Timestamps
from surffollow.shm.layout_adaptive import FAULT_NAMES, HEALTH_NAMES, reason_text
from surffollow.shm.layout_adaptive_estimation import N_MODELS
from surffollow.shm.layout_follow import MODE_ADAPTIVE, POSE_STALE, STATUS_NAMES, VALID

_OUTPUT = ("t_ns", "pose_t_ns", "cycle", "height_m", "slope", "speed_mps", "delta_h_m", "error_m")
_ADAPTED = (
    *("sigma_m", "noise_m", "roughness_m", "late_s", "latency_s", "tau_s", "permitted_variance_m"),
    *("interval_size_m", "range_size", "beams"),
)


def state_report(params: Any, state: Any, output: Any, stamps: Timestamps) -> dict[str, Any]:
    """The dictionary that `Follower.state` describes.

    Parameters
    ----------
    params, state, output : records of `Params`, `FollowState`, `Output`
    stamps : Timestamps      of poses, readings and other steps
    """
    bits, adaptive = int(output["status"]), params["mode"] == MODE_ADAPTIVE
    out: dict[str, Any] = {
        "status": [n for k, n in enumerate(STATUS_NAMES) if bits >> k & 1],
        "mode": "adaptive" if adaptive else "paper",
        "offset_m": float(params["offset_m"]),
        "poses_refused": int(state["sense"]["poses_refused"]),
    }
    out.update({n: output[n].item() for n in _OUTPUT})
    for stamp in ("t_ns", "pose_t_ns"):
        out[stamp] -= SHIFT_NS if out[stamp] else 0  # 0: before the first step, or pose
    if adaptive:
        out["health"], out["reason"] = health_report(params, output, stamps)
        out["faults"] = [n for k, n in enumerate(FAULT_NAMES) if int(output["faults"]) >> k & 1]
        out.update({n: output[n].item() for n in _ADAPTED})
        out["preview_share"] = float(state["adaptive"]["preview"]["share"])
        out["weights"] = state["adaptive"]["weights"]["weight"][:N_MODELS].tolist()
        if state["adaptive"]["plane"]["count"] > 0:
            out["normal"] = output["normal"].tolist()
    out["demand"] = output["demand"].tolist()
    out["range_m"] = output["range_m"][: int(params["n_channels"])].tolist()
    return out


def health_report(params: Any, output: Any, stamps: Timestamps) -> tuple[str, str]:
    """Health and its reason, those of wrong timestamps included.

    Parameters
    ----------
    params, output : records of `Params`, `Output`
    stamps : Timestamps      of poses, readings and other steps
    """
    bits, timeout_ns = int(output["status"]), int(params["pose_timeout_ns"])
    health, reason = HEALTH_NAMES[int(output["health"])], reason_text(int(output["reason"]))
    if bits & VALID == 0:
        # readings far behind are late, as long as another step gives the time
        behind_ns = timeout_ns if bits & POSE_STALE else max(timeout_ns, stamps.time.jump_ns)
        apart = stamps.reason_of_offset(behind_ns, timeout_ns)
        if apart:
            return "DROPOUT", apart
    shifted = stamps.reason_of_shift() or stamps.reason_of_drift(1e9 * float(output["tau_s"]))
    return ("SUSPECT", shifted) if health == "OK" and shifted else (health, reason)
