"""Parameters: names, bounds and units; every refusal names the key and the remedy."""

from __future__ import annotations

import math

import pytest

from surffollow.config.params import OLD_NAMES, PARAMS, check_param, names_given, param_name
from surffollow.errors import ConfigError


@pytest.mark.parametrize(
    ("name", "value", "number"),
    [
        ("offset_m", 0.1, 0.1),
        ("offset", "4 in", 0.1016),
        ("interval_size", "2 mm", 0.002),
        ("pose_timeout", "100 ms", 100e6),
        ("pose_timeout_ns", 100_000_000, 100e6),
        ("sensor_readings", 7, 7.0),
        ("mode", "paper", 0.0),
        ("mode", "adaptive", 1.0),
        ("run", "freeze", 2.0),
        ("pose_interpolate", "interpolated", 1.0),
        ("preview", False, 0.0),
        ("orient", True, 1.0),
        ("plant_v_max", "200 mm/s", 0.2),
        ("loss_timeout", "2s", 2e9),
        ("loss_timeout_ns", 2, 2.0),
        ("loss_timeout_ns", "2500000000 ns", 2.5e9),
        ("sensor_latency", 0, 0.0),
        ("hold", "0", 0.0),
        ("max_demand", 0.02, 0.02),
        ("sensor_readings", "7", 7.0),
        ("plant_tau", 0.2, 0.2),
    ],
)
def test_a_parameter_is_taken_with_or_without_its_unit_ending(name, value, number):
    assert check_param(name, value) == pytest.approx(number, rel=1e-15)


def test_a_quantity_with_a_unit_is_refused_without_the_remedy_for_numbers():
    with pytest.raises(ConfigError) as refused:
        check_param("plant_tau", "500 s")
    assert "without a unit" not in str(refused.value)
    assert check_param("plant_tau", "10.24 s") == 10.24  # the slowest axis of the tests of scales


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("ofset", 0.1, ["unknown parameter 'ofset'", "did you mean offset_m"]),
        ("standoff", 0.1, ["unknown parameter 'standoff'; did you mean offset_m?"]),
        ("stand_off_m", 0.1, ["did you mean offset_m?"]),
        ("tau_s", 0.1, ["did you mean plant_tau_s?"]),
        ("Range_Size", 5, ["unknown parameter 'Range_Size'", "range_size"]),
        ("offset", "3 s", ["offset", "'s' is a time", "length"]),
        ("offset", "3 furlongs", ["offset", "unknown unit 'furlongs'", "use one of"]),
        ("offset", -1.0, ["offset", "-1 m", "between 0.0001 and 1000 m"]),
        ("offset", math.nan, ["offset", "finite"]),
        ("offset", math.inf, ["offset", "finite"]),
        ("offset", None, ["offset", "no quantity"]),
        ("plant_tau", 500, ["500 s", "between 0.0001 and 20 s", "is in s: write '500 ms' for ms"]),
        ("plant_tau", 25, ["write '25 ms' for ms"]),
        ("offset", 5000, ["5000 m", "is in m: write '5000 mm' for mm"]),
        ("sensor_readings", 0, ["sensor_readings", "between 1 and 64"]),
        ("sensor_readings", 65, ["sensor_readings", "between 1 and 64"]),
        ("sensor_readings", 2.5, ["sensor_readings", "whole"]),
        ("range_size", 513, ["range_size", "between 1 and 512"]),
        ("mode", "best", ["mode", "'best'", "paper, adaptive"]),
        ("run", 3, ["run", "between 0 and 2"]),
        ("offset", True, ["offset", "True", "a number"]),
        ("mode", True, ["mode is True", "one of paper, adaptive"]),
        ("run", True, ["run is True", "one of normal, dryrun, freeze"]),
        ("pose_interpolate", True, ["True", "one of latest, interpolated"]),
        ("noise_share", True, ["True", "a number"]),
        ("loss_timeout", 2, ["loss_timeout = 2 has no unit", "'2 s' or '30 ms'", "loss_timeout_ns"]),
        ("loss_timeout", 2_500_000_000, ["loss_timeout = 2500000000 has no unit", "loss_timeout_ns"]),
        ("loss_timeout", "2", ["loss_timeout = 2 has no unit", "'2 s' or '30 ms'"]),
        ("loss_timeout_ns", "2", ["'2' has no unit", "'2 ms', or 2 without quotes for ns"]),
        ("offset", "0.1", ["parameter offset: '0.1' has no unit", "'0.1 mm', or 0.1 without quotes for m"]),
        ("pose_timeout", 0.1, ["pose_timeout = 0.1 has no unit", "'2 s' or '30 ms'"]),
        ("hold", 3.5e6, ["hold = 3500000.0 has no unit", "hold_ns"]),
        ("sensor_latency", 0.03, ["sensor_latency = 0.03 has no unit", "'2 s' or '30 ms'"]),
        ("sensor_latency_ns", 0.03, ["sensor_latency_ns is 0.03", "whole number of ns", "'30 ms'"]),
    ],
)
def test_a_refusal_names_the_parameter_what_is_wrong_and_what_would_be_right(name, value, says):
    with pytest.raises(ConfigError) as e:
        check_param(name, value)
    for part in says:
        assert part in str(e.value)


@pytest.mark.parametrize("name", PARAMS)
def test_defaults_and_both_bounds_are_accepted_and_just_beyond_is_not(name):
    spec = PARAMS[name]
    for value in (spec.default, spec.low, spec.high):
        assert check_param(name, value) == value
    for value in (spec.low - 1.0, spec.high * 2.0 + 1.0):
        with pytest.raises(ConfigError):
            check_param(name, value)


def test_the_papers_figures_are_the_defaults():
    assert PARAMS["sensor_readings"].default == 7
    assert PARAMS["pose_interpolate"].default == 0
    assert PARAMS["pose_timeout_ns"].default == 100e6


def test_unit_endings_are_optional_and_never_ambiguous():
    for name in PARAMS:
        assert param_name(name) == name
    short = [n.rsplit("_", 1)[0] for n in PARAMS if n.rsplit("_", 1)[-1] in ("m", "ns", "s", "mps")]
    assert len(short) == len(set(short))
    for name in short:
        assert param_name(name).startswith(name)


@pytest.mark.parametrize(("old", "new"), OLD_NAMES.items())
def test_an_old_name_of_a_parameter_is_accepted_for_one_release(old, new):
    assert old not in PARAMS
    assert param_name(old) == new
    assert check_param(old, PARAMS[new].default) == PARAMS[new].default


@pytest.mark.parametrize("name", [name for name, spec in PARAMS.items() if spec.unit == "ns"])
def test_a_bare_number_of_ns_needs_the_name_that_says_so(name):
    short = name.removesuffix("_ns")
    with pytest.raises(ConfigError, match="has no unit"):
        check_param(short, PARAMS[name].default)
    assert check_param(name, PARAMS[name].default) == PARAMS[name].default
    assert check_param(short, f"{PARAMS[name].default} ns") == PARAMS[name].default


@pytest.mark.parametrize(
    ("names", "both"),
    [
        (("offset", "mode", "offset_m"), "as offset and as offset_m"),
        (("step_way", "step_travel"), "step_way and"),
    ],
)
def test_two_names_of_one_parameter_are_refused_and_both_are_named(names, both):
    with pytest.raises(ConfigError, match=both):
        names_given(names)
