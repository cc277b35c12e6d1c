"""Followers in the benchmark: those of this installation, and those given as `module:name`."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Any, Protocol

from surffollow.benchmark.conditions import Conditions
from surffollow.errors import UsageError


class FollowerLike(Protocol):
    """Interface of a follower."""

    def pose(self, t_ns: int, pose: Any) -> None:
        """Take a pose report that was true at `t_ns`: x y z [m], qx qy qz qw."""

    def step(self, t_ns: int, ranges_m: Any) -> Sequence[float]:
        """Take ranges read at `t_ns` [m], NaN for none, and return the demand (6,) [m, rad]."""


Factory = Callable[[Conditions], FollowerLike]


def follower_config(conditions: Conditions) -> dict[str, Any]:
    """Return the configuration of `surffollow.Follower`: sensor mount and window, nominal plant; no more.

    Everything else keeps its default: one configuration for every surface, speed and noise.
    """
    sensor = conditions.sensor
    return {
        "sensors": [
            {
                "position_m": [conditions.lead_m, 0.0, 0.0],
                "near_m": sensor.near_m,
                "far_m": sensor.far_m,
            }
        ],
        "plant": {
            "tau_s": conditions.nominal_tau_s,
            "v_max_mps": conditions.plant.v_max_mps,
            "a_max_mps2": conditions.plant.a_max_mps2,
        },
    }


def _follower_factory(choices: dict[str, Any]) -> Factory:
    def make(conditions: Conditions) -> FollowerLike:
        follower: Any = importlib.import_module("surffollow").Follower
        made: FollowerLike = follower(
            config=follower_config(conditions) | choices, offset_m=conditions.standoff_m
        )
        return made

    return make


def followers() -> dict[str, Factory]:
    """Return the followers that this installation has, by row name."""
    if find_spec("surffollow.follower") is None:
        return {}
    # the paper uses the newest pose there is, with any timestamp of the reading
    return {
        "paper": _follower_factory({"mode": "paper", "pose_interpolate": "latest"}),
        "ours": _follower_factory({}),
    }


def outside_follower(spec: str) -> Factory:
    """Find a factory given as `module:name`; it is called with the `Conditions` of a run.

    Raises
    ------
    UsageError
        when there is no such module or name
    """
    module, _, name = spec.partition(":")
    try:
        factory: Factory = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        remedy = "expected module:factory"
        if isinstance(error, ModuleNotFoundError):
            remedy += "; add the folder of the module to PYTHONPATH (PYTHONPATH=. for this one)"
        raise UsageError(f"no follower at '{spec}' ({error}); {remedy}") from error
    return factory


def check_follower(spec: str) -> None:
    """Construct the follower given as `module:name` once to validate its interface.

    Raises
    ------
    UsageError
        when there is no such factory, it fails, or what it makes has not the methods of a `FollowerLike`
    """
    try:
        made = outside_follower(spec)(Conditions())
    except UsageError:
        raise
    except Exception as error:
        raise UsageError(
            f"'{spec}' makes no follower: called with the benchmark's Conditions it raised "
            f"{type(error).__name__}: {error}"
        ) from error
    lacking = [name for name in ("pose", "step") if not callable(getattr(made, name, None))]
    if lacking:
        raise UsageError(
            f"'{spec}' makes no follower: what it returned has no method {' and no '.join(lacking)}; "
            "expected a factory whose product has pose(t_ns, pose) and step(t_ns, ranges_m)"
        )
