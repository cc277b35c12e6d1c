"""Quantities as people write them."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from surffollow.errors import UsageError
from surffollow.units import decimal_number, format_ns, is_bare, numbers_text, parse_quantity, unit_scale


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("0.1 in", "m", 0.00254),
        ("0.1in", "m", 0.00254),
        ("7 ms", "s", 0.007),
        ("7 ms", "ns", 7e6),
        ("120us", "s", 120e-6),
        ("120 µs", "ns", 120e3),
        ("20 deg", "rad", math.pi / 9),
        ("180°", "rad", math.pi),
        ("1 kHz", "Hz", 1000.0),
        ("36 km/h", "m/s", 10.0),
        ("-3.5e-2 m", "m", -0.035),
        ("+.5 mm", "m", 0.0005),
        (" 2 ft ", "m", 0.6096),
        ("50 %", "1", 0.5),
        ("4 KiB", "B", 4096.0),
        ("12", "1", 12.0),
        ("0", "m", 0.0),
        (12, "m", 12.0),
        (0.25, "s", 0.25),
    ],
)
def test_a_quantity_is_converted_into_the_asked_unit(text, unit, value):
    assert parse_quantity(text, unit) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(
    ("value", "unit", "says"),
    [
        ("0.1 inch", "m", "unknown unit 'inch'; use one of cm, ft, in, km, m, mm"),
        ("3 parsec", "1", "unknown unit 'parsec'"),
        ("7 ms", "m", "'ms' is a time, but a length in 'm'"),
        ("7 m", "ns", "'m' is a length, but a time in 'ns'"),
        ("7 deg", "m", "'deg' is an angle, but a length in 'm'"),
        ("ten m", "m", "'ten m' is no quantity; write a number and a unit, like '5 m'"),
        ("", "m", "no quantity"),
        ("1 2 m", "m", "1 2 m"),
        ("1e999 m", "m", "not a finite quantity"),
        ("nan", "m", "no quantity"),
        (math.nan, "m", "not a finite quantity"),
        (math.inf, "m", "not a finite quantity"),
        (10**400, "m", "the number is beyond 1.8e308"),
        (True, "m", "True is no quantity"),
        (None, "s", "None is no quantity; write a number or text like '5 s'"),
        ("300", "m", "'300' has no unit; write one, like '300 mm', or 300 without quotes for m"),
        ("0.1", "s", "like '0.1 ms', or 0.1 without quotes for s"),
        ("5", "rad/s", "like '5 rad/s'"),
        ([1], "s", "no quantity"),
        (b"1 m", "m", "no quantity"),
    ],
)
def test_what_is_no_quantity_is_refused_with_a_remedy(value, unit, says):
    with pytest.raises(UsageError) as e:
        parse_quantity(value, unit)
    assert says in str(e.value)


def test_an_option_of_a_command_is_text_and_may_be_a_bare_number():
    assert parse_quantity("0.1", "m/s", bare=True) == 0.1


@given(st.text(max_size=30))
def test_any_text_gives_a_finite_number_or_a_usage_error(text):
    try:
        number = parse_quantity(text, "m")
    except UsageError:
        return
    assert math.isfinite(number)


@given(st.floats(-1e12, 1e12), st.sampled_from(["mm", "in", "ft", "km", "um"]))
def test_scales_are_each_others_inverse(number, unit):
    there = parse_quantity(f"{number!r} {unit}", "m")
    assert there * unit_scale("m", unit) == pytest.approx(number, rel=1e-14)


@pytest.mark.parametrize(
    ("t_ns", "text"),
    [
        (0, "0 ns"),
        (850, "850 ns"),
        (12_340, "12.3 µs"),
        (4_560_000, "4.56 ms"),
        (999_999_000, "1 s"),
        (1_200_000_000, "1.2 s"),
        (86_100_000_000_000, "86100 s"),
    ],
)
def test_durations_as_text(t_ns, text):
    assert format_ns(t_ns) == text


@given(
    st.integers(1, 10**15),
    st.sampled_from(
        [("us", "s", 6), ("µs", "s", 6), ("ms", "s", 3), ("ns", "s", 9), ("mm", "m", 3), ("um", "m", 6)]
    ),
)
def test_a_decimal_quantity_is_the_float_that_the_same_decimal_number_is(number, units):
    unit, si_unit, digits = units
    assert parse_quantity(f"{number} {unit}", si_unit) == float(f"{number}e-{digits}")
    assert parse_quantity(f"{number}.5 {si_unit}", unit) == float(f"{number}.5e{digits}")


@pytest.mark.parametrize("text", ["1e999999999 mm", "-1e999999999 mm"])
def test_a_number_beyond_all_floats_is_refused_at_once(text):
    with pytest.raises(UsageError, match="not a finite quantity"):
        parse_quantity(text, "m")


@pytest.mark.parametrize("text", ["1e-999999999 mm", "0e999999999 mm"])
def test_a_number_below_all_floats_is_zero_at_once(text):
    assert parse_quantity(text, "m") == 0.0


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (0.000123456789, "0.000123457"),
        (123.456789, "123.457"),
        (-512345.6789, "-512345.679"),
        (5812345.0, "5812345"),
        (5812000.0, "5812000"),
        (1732716000.02, "1732716000.02"),
        (0.0, "0"),
        (math.nan, "nan"),
        (-math.inf, "-inf"),
        (1e300, "1e+300"),
    ],
)
def test_a_number_for_people_has_six_digits_and_its_thousandths(number, text):
    assert numbers_text(number) == text


@pytest.mark.parametrize("text", ["1_5.0", "1_732", "", "1,5", "0x10"])
def test_what_no_table_means_as_a_number_is_none(text):
    with pytest.raises(ValueError, match=r"could not convert|no decimal number"):
        decimal_number(text)


def test_a_text_of_thousands_of_digits_is_refused_at_once() -> None:
    """The pattern tried the square and the cube of its length; minutes passed."""
    for text in (5000 * "9" + "\n[sensor] sigma", 20_000 * "1" + " a b"):
        with pytest.raises(UsageError, match=f"a text of {len(text)} characters is no quantity"):
            parse_quantity(text, "m")
        assert is_bare(text)
    assert parse_quantity(300 * "0" + "1.5 mm", "m") == 0.0015
