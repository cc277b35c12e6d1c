"""The methods of the benchmark: compiled baselines, and followers behind one interface.

A follower is any object with `pose(t_ns, pose)` and `step(t_ns, ranges_m)`; `surffollow.Follower` is one,
and `--methods NAME=module:factory` adds any other. A method that cannot be imported is not registered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from surffollow.benchmark import baselines as b
from surffollow.benchmark.followers import Factory, check_follower, followers, outside_follower
from surffollow.errors import UsageError

LIMIT = "limit"
ORACLE = ":oracle"


@dataclass(frozen=True)
class Parameter:
    """A number to tune: name with unit, bounds (above 0), whether it matters only with a lead."""

    name: str
    low: float
    high: float
    leading_only: bool = False


@dataclass(frozen=True)
class Baseline:
    """A jitted loop: `kind` of `baselines`, what may be tuned, starting values, fixed parameters behind.

    `evaluations` is the budget of a tuning; `leading` methods run with a leading sensor only.
    """

    name: str
    kind: int
    tunable: tuple[Parameter, ...] = ()
    starts: tuple[tuple[float, ...], ...] = ((),)
    fixed: tuple[float, ...] = ()
    evaluations: int = 100
    leading: bool = False


_LAG = Parameter("lag_s", 1e-3, 0.6)
_KALMAN = (
    Parameter("slope_noise", 1e-3, 100.0),
    Parameter("height_noise", 1e-6, 0.1),
    Parameter("gate_sigma", 2.0, 50.0),
    Parameter("rejects", 1.0, 10.0),
)
_KALMAN_STARTS = (
    (1.0, 1e-3, 5.0, 3.0, 0.05),
    (0.1, 1e-4, 5.0, 4.0, 0.05),
    (5.0, 1e-2, 8.0, 3.0, 0.04),
    (5.0, 1e-3, 4.0, 4.0, 0.001),
    (0.01, 2e-2, 8.0, 3.0, 0.03),
)
_LAG_OF_LEAD = Parameter("lag_s", 1e-3, 0.6, leading_only=True)

BASELINES: dict[str, Baseline] = {
    m.name: m
    for m in (
        Baseline("hold", b.HOLD, fixed=(0.0,)),
        Baseline("p", b.P, (Parameter("gain", 0.01, 5.0),), ((0.1,), (0.3,), (0.7,))),
        Baseline(
            "pi",
            b.PI,
            (Parameter("gain", 0.01, 5.0), Parameter("integral_hz", 0.01, 30.0)),
            ((0.2, 0.01), (1.2, 0.01), (0.1, 0.3), (0.3, 0.5), (0.5, 2.0), (1.7, 7.0)),
        ),
        Baseline(
            "lpf-gate",
            b.LPF_GATE,
            (Parameter("tau_s", 1e-3, 0.5), Parameter("gate_m", 0.2e-3, 0.05), _LAG_OF_LEAD),
            ((0.003, 3e-3, 0.06), (0.01, 5e-3, 0.05), (0.05, 2e-3, 0.05)),
        ),
        Baseline(
            "kalman-ff",
            b.KALMAN_FF,
            (*_KALMAN, _LAG),
            _KALMAN_STARTS,
            fixed=(b.POLICY_EXTRAPOLATE,),
        ),
        Baseline(
            "kalman-wave",
            b.KALMAN_WAVE,
            (*_KALMAN, _LAG, Parameter("wave_m", 0.03, 1.0), Parameter("wave_noise", 1e-5, 0.1)),
            (
                *((1.0, 1e-3, 5.0, 3.0, 0.05, wave_m, 1e-3) for wave_m in (0.08, 0.1, 0.15, 0.2, 0.3, 0.4)),
                (0.1, 1e-4, 5.0, 4.0, 0.05, 0.2, 1e-3),
                (5.0, 1e-2, 8.0, 3.0, 0.04, 0.2, 1e-2),
                (0.01, 2e-2, 8.0, 3.0, 0.03, 0.2, 1e-2),
            ),
            evaluations=140,
        ),
        Baseline(
            "kalman-adaptive",
            b.KALMAN_ADAPTIVE,
            (*_KALMAN, _LAG, Parameter("memory_readings", 5.0, 10_000.0)),
            tuple(
                (*start, memory) for start, memory in zip(_KALMAN_STARTS, (100.0, 500.0, 50.0, 300.0, 1000.0))
            ),
            evaluations=120,
        ),
        Baseline(
            "preview",
            b.PREVIEW,
            (*_KALMAN, Parameter("smooth_m", 0.2e-3, 8e-3), Parameter("effort_s4", 1e-12, 1e-5)),
            (
                (1.0, 1e-3, 5.0, 3.0, 2e-3, 1e-8),
                (5.0, 1e-2, 8.0, 3.0, 1e-3, 1e-8),
                (0.2, 1e-4, 7.0, 4.0, 4e-3, 1e-8),
                (0.1, 1e-4, 5.0, 4.0, 6e-3, 1e-7),
            ),
            evaluations=80,
            leading=True,
        ),
    )
}


def factory_of(method: str) -> Factory:
    """Return the factory of a row that is not a baseline: a registered follower or `NAME=module:factory`."""
    name, _, spec = method.partition("=")
    if spec:
        return outside_follower(spec)
    known = followers()
    if name not in known:
        raise UsageError(f"no method '{name}' here; there are {', '.join(all_methods())}")
    return known[name]


def all_methods() -> list[str]:
    """Return every row this installation can make, in the order of the table."""
    rows: list[str] = []
    for name, baseline in BASELINES.items():
        rows += [name] + ([name + ORACLE] if baseline.tunable else [])
    return [*rows, *followers(), LIMIT]


def check_methods(methods: Sequence[str]) -> list[str]:
    """Return the methods, once each, after finding every one.

    Raises
    ------
    UsageError
        for a method that does not exist
    """
    known = all_methods()
    for method in methods:
        if "=" in method:
            check_follower(method.partition("=")[2])
        elif method not in known:
            raise UsageError(f"no method '{method}' here; there are {', '.join(all_methods())}")
    return list(dict.fromkeys(methods))
