"""Every tunable parameter of the follower: default, bounds, unit; the paper's names in lower case.

A parameter's number, as requests carry it, is its word index in `Params`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from surffollow.errors import ConfigError
from surffollow.units import is_bare, parse_quantity

INCH_M = 0.0254
SWITCH = ("off", "on")  # False and True, too


@dataclass(frozen=True)
class ParamSpec:
    """Default and bounds [in `unit`]; `whole`: an integer; `choices`: names for the values 0, 1, …"""

    default: float
    low: float
    high: float
    unit: str = "1"
    whole: bool = False
    choices: tuple[str, ...] = ()


PARAMS: dict[str, ParamSpec] = {
    "mode": ParamSpec(1, 0, 1, whole=True, choices=("paper", "adaptive")),
    "run": ParamSpec(0, 0, 2, whole=True, choices=("normal", "dryrun", "freeze")),
    "offset_m": ParamSpec(0.1, 1e-4, 1e3, "m"),
    "sensor_readings": ParamSpec(7, 1, 64, whole=True),
    "ee_readings": ParamSpec(4, 1, 64, whole=True),
    "interval_size_m": ParamSpec(0.002, 1e-6, 1e3, "m"),
    "range_size": ParamSpec(5, 1, 512, whole=True),
    "permitted_variance_m": ParamSpec(1e-4, 0.0, 1e3, "m"),
    "max_demand_m": ParamSpec(0.05, 0.0, 1e3, "m"),
    "pose_timeout_ns": ParamSpec(100e6, 1e6, 60e9, "ns", whole=True),
    "loss_timeout_ns": ParamSpec(2.5e9, 0, 3600e9, "ns", whole=True),
    "pose_interpolate": ParamSpec(0, 0, 1, whole=True, choices=("latest", "interpolated")),
    "too_close_m": ParamSpec(2.15 * INCH_M, 0.0, 1e3, "m"),
    "too_close_exit_m": ParamSpec(2.3 * INCH_M, 0.0, 1e3, "m"),
    "range_min_m": ParamSpec(2.0 * INCH_M, 0.0, 1e6, "m"),
    "range_max_m": ParamSpec(6.0 * INCH_M, 1e-6, 1e6, "m"),
    "sensor_latency_ns": ParamSpec(30e6, 0, 10e9, "ns", whole=True),
    # up to twice that of the slowest axis of the tests: the time-outs that follow from it have bounds, too
    "plant_tau_s": ParamSpec(0.04, 1e-4, 20.0, "s"),
    "plant_v_max_mps": ParamSpec(0.2, 1e-6, 1e3, "m/s"),
    "plant_a_max_mps2": ParamSpec(2.0, 1e-8, 1e6, "m/s^2"),
    "score_travel_m": ParamSpec(0.25, 1e-6, 1e4, "m"),
    "score_time_s": ParamSpec(2.0, 1e-4, 1e5, "s"),
    "score_power": ParamSpec(10.0, 0.0, 100.0),
    "long_power": ParamSpec(3.0, 0.0, 100.0),
    "long_factor": ParamSpec(12.0, 1.0, 1e3),
    "noise_share": ParamSpec(0.97, 0.0, 1.0),
    "score_floor_m": ParamSpec(3e-5, 1e-9, 10.0, "m"),
    "gate_scales": ParamSpec(8.0, 1.0, 1e3),
    "gate_m": ParamSpec(1e-3, 0.0, 1e3, "m"),
    "step_travel_m": ParamSpec(2.5e-3, 0.0, 1e3, "m"),
    "step_samples": ParamSpec(3, 1, 100, whole=True),
    "max_wait_s": ParamSpec(0.005, 0.0, 100.0, "s"),
    "plan_effort_s4": ParamSpec(6e-8, 0.0, 1e12),
    "orient": ParamSpec(1, 0, 1, whole=True, choices=SWITCH),
    "max_turn_rad": ParamSpec(0.35, 0.0, 1.6, "rad"),
    "permitted_turn_rad": ParamSpec(1e-3, 0.0, 1.6, "rad"),
    "deadband_share": ParamSpec(0.1, 0.0, 10.0),
    "adapt": ParamSpec(1, 0, 1, whole=True, choices=("frozen", "learn")),
    "hold_ns": ParamSpec(3.5e6, 0, 10e9, "ns", whole=True),
    "dropout_travel_m": ParamSpec(0.06, 1e-6, 1e4, "m"),
    "max_speed_mps": ParamSpec(4.0, 1e-8, 1e8, "m/s"),
    "max_accel_mps2": ParamSpec(800.0, 1e-9, 1e13, "m/s^2"),
    "max_jerk_mps3": ParamSpec(4e5, 1e-12, 1e15, "m/s^3"),
    "toward_factor": ParamSpec(0.5, 0.01, 1.0),
    "max_turn_speed_radps": ParamSpec(1.0, 1e-6, 1e4, "rad/s"),
    "max_turn_accel_radps2": ParamSpec(20.0, 1e-9, 1e8, "rad/s^2"),
    "max_tilt_rad": ParamSpec(0.8, 0.0, 1.5, "rad"),
    "preview": ParamSpec(1, 0, 1, whole=True, choices=SWITCH),
}

_UNIT_ENDING = re.compile(r"_(?:ns|s|m|rad)(?:ps)?\d?$")
# endings that a name may lack: no ending first, so that a full name is always itself
UNIT_ENDINGS = ("", *sorted({found[0] for name in PARAMS if (found := _UNIT_ENDING.search(name))}))


def check_param(name: str, value: object) -> float:
    """The value of a parameter as a number in the parameter's unit, checked.

    Parameters
    ----------
    name : str
        one of `PARAMS`, with or without its unit ending ("offset" = "offset_m")
    value : object
        a number, text with a unit, or one of the parameter's choices; False and True for off and on. A
        number is in SI units. A duration in ns is 0, or needs the full name ("hold_ns")

    Raises
    ------
    ConfigError
        unknown name, wrong or missing unit, not whole, out of bounds
    """
    spec = PARAMS[param_name(name)]
    if spec.choices and isinstance(value, str):
        if value not in spec.choices:
            raise ConfigError(f"parameter {name} is {value!r}; it must be one of {', '.join(spec.choices)}")
        return float(spec.choices.index(value))
    if isinstance(value, bool):
        if spec.choices == SWITCH:
            return float(value)
        expected = f"one of {', '.join(spec.choices)}" if spec.choices else "a number"
        raise ConfigError(f"parameter {name} is {value}; it must be {expected}")
    try:
        number = parse_quantity(value, spec.unit, bare=spec.unit == "ns" and not name.endswith("_ns"))
    except ValueError as e:
        raise ConfigError(f"parameter {name}: {e}") from None
    if spec.unit == "ns" and not name.endswith("_ns") and number != 0.0 and is_bare(value):
        raise ConfigError(
            f"parameter {name} = {value} has no unit; give one, for instance '2 s' or '30 ms', "
            f"or write {param_name(name)} for a number of ns"
        )
    if spec.whole:
        if abs(number - round(number)) > 1e-9 * max(1.0, abs(number)):
            remedy = " of ns, or text with a unit, for instance '30 ms'" if spec.unit == "ns" else ""
            raise ConfigError(f"parameter {name} is {value!r}; it must be a whole number{remedy}")
        number = float(round(number))  # "0.5 s" in ns is whole but for its last bit
    if not spec.low <= number <= spec.high:
        unit = "" if spec.unit == "1" else f" {spec.unit}"
        remedy = ""
        if spec.unit in ("m", "s") and number > spec.high and is_bare(value):
            small = f"m{spec.unit}"
            remedy = f"; a number without a unit is in{unit}: write '{number:g} {small}' for {small}"
        raise ConfigError(
            f"parameter {name} is {number:g}{unit}; it must be between {spec.low:g} and "
            f"{spec.high:g}{unit}{remedy}"
        )
    return number


# names before the terms of the field; they work for one release, with the ending or without
OLD_NAMES = {
    "calm_share": "deadband_share",
    "dropout_way": "dropout_travel_m",
    "dropout_way_m": "dropout_travel_m",
    "plan_calm": "plan_effort_s4",
    "plan_calm_s4": "plan_effort_s4",
    "score_way": "score_travel_m",
    "score_way_m": "score_travel_m",
    "step_way": "step_travel_m",
    "step_way_m": "step_travel_m",
    "tick_lead": "max_wait_s",
    "tick_lead_s": "max_wait_s",
}


# words of the documents, of plant files and of `Follower` that are no parameters, for the text of an error
MEANT = {
    "standoff": "offset_m",
    "stand_off": "offset_m",
    "tau": "plant_tau_s",
    "v_max": "plant_v_max_mps",
    "a_max": "plant_a_max_mps2",
    "latency": "sensor_latency_ns",
    "near": "range_min_m",
    "far": "range_max_m",
}


def param_name(name: str, others: Iterable[str] = ()) -> str:
    """The full name of a parameter.

    Parameters
    ----------
    name : with or without the ending of the name
    others : keys beside the parameters that the error names, too

    Raises
    ------
    ConfigError  there is none; the text has the nearest names
    """
    name = OLD_NAMES.get(name, name)
    for ending in UNIT_ENDINGS:
        if name + ending in PARAMS:
            return name + ending
    import difflib

    known = (*others, *PARAMS)
    meant = [full for word, full in MEANT.items() if name in (word + ending for ending in UNIT_ENDINGS)]
    near = meant or difflib.get_close_matches(name, known, n=3)
    hint = f"; did you mean {' or '.join(near)}?" if near else f"; known: {', '.join(known)}"
    raise ConfigError(f"unknown parameter {name!r}{hint}")


def names_given(names: Iterable[str], where: str = "", others: Iterable[str] = ()) -> dict[str, str]:
    """Full name of every parameter that is named → its name as given.

    Parameters
    ----------
    names : of parameters, as `check_param` takes them
    where : for the text of the error, as in " under [follow]"
    others : keys beside the parameters that the error names, too

    Raises
    ------
    ConfigError  unknown name, or two names of one parameter
    """
    given: dict[str, str] = {}
    for name in names:
        add_given(given, param_name(name, others), name, where)
    return given


def add_given(given: dict[str, str], full: str, name: str, where: str = "") -> None:
    """Note that `name` gives parameter `full`; ConfigError with both names when it was given before."""
    if full in given:
        raise ConfigError(
            f"parameter {full} is given twice{where}, as {given[full]} and as {name}; give one of them"
        )
    given[full] = name
