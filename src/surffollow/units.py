"""Quantities as people write them ("0.1 in", "7 ms", "20 deg") to SI numbers, and back for display."""

from __future__ import annotations

import math
import re
from fractions import Fraction

from surffollow.errors import UsageError

# unit → (dimension, factor to SI); a float stands for the decimal number that is written here
_UNITS: dict[str, tuple[str, float | Fraction]] = {
    "m": ("length", 1.0),
    "km": ("length", 1e3),
    "cm": ("length", 1e-2),
    "mm": ("length", 1e-3),
    "um": ("length", 1e-6),
    "µm": ("length", 1e-6),
    "in": ("length", 0.0254),
    "ft": ("length", 0.3048),
    "s": ("time", 1.0),
    "ms": ("time", 1e-3),
    "us": ("time", 1e-6),
    "µs": ("time", 1e-6),
    "ns": ("time", 1e-9),
    "min": ("time", 60.0),
    "Hz": ("frequency", 1.0),
    "kHz": ("frequency", 1e3),
    "rad": ("angle", 1.0),
    "mrad": ("angle", 1e-3),
    "deg": ("angle", math.pi / 180.0),
    "°": ("angle", math.pi / 180.0),
    "m/s": ("speed", 1.0),
    "mm/s": ("speed", 1e-3),
    "cm/s": ("speed", 1e-2),
    "in/s": ("speed", 0.0254),
    "km/h": ("speed", Fraction(5, 18)),
    "m/s^2": ("acceleration", 1.0),
    "m/s2": ("acceleration", 1.0),
    "mm/s^2": ("acceleration", 1e-3),
    "m/s^3": ("jerk", 1.0),
    "m/s3": ("jerk", 1.0),
    "rad/s": ("angular speed", 1.0),
    "deg/s": ("angular speed", math.pi / 180.0),
    "rad/s^2": ("angular acceleration", 1.0),
    "deg/s^2": ("angular acceleration", math.pi / 180.0),
    "B": ("size", 1.0),
    "KiB": ("size", 1024.0),
    "MiB": ("size", 1024.0**2),
    "GiB": ("size", 1024.0**3),
    "1": ("number", 1.0),
    "%": ("number", 1e-2),
    "V": ("voltage", 1.0),
}
# what an error shows as a unit that a quantity can have
_USUAL = {"m": "mm", "s": "ms", "ns": "ms", "rad": "deg", "m/s": "mm/s"}
_QUANTITY = re.compile(r"^\s*([-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?)\s*(\S*)\s*$")
MAX_CHARACTERS = 1000  # of a quantity; the time to find that a text is none grows with its square


def unit_scale(unit: str, si_unit: str) -> float:
    """Factor from `unit` to `si_unit`.

    Parameters
    ----------
    unit : str
        of the given number
    si_unit : str
        of the result

    Returns
    -------
    float
        factor

    Raises
    ------
    UsageError
        when either is unknown or their dimensions differ

    Examples
    --------
    >>> from surffollow.units import unit_scale
    >>> unit_scale("in", "mm"), unit_scale("ms", "ns")
    (25.4, 1000000.0)
    """
    return float(_exact_scale(unit, si_unit))


def _one(quantity: str) -> str:
    """A quantity with its article."""
    return f"{'an' if quantity[0] in 'aeiou' else 'a'} {quantity}"


def _exact_scale(unit: str, si_unit: str) -> Fraction:
    """`unit_scale` without rounding: "20 us" is the number 20e-6, which 20 · 1e-6 in floats is not."""
    for u in (unit, si_unit):
        if u not in _UNITS:
            known = ", ".join(sorted(n for n, (d, _) in _UNITS.items() if d == _UNITS.get(si_unit, ("",))[0]))
            raise UsageError(f"unknown unit {u!r}; {'use one of ' + known if known else 'see the manual'}")
    (given, factor), (expected, si) = _UNITS[unit], _UNITS[si_unit]
    if given != expected:
        raise UsageError(
            f"unit {unit!r} is {_one(given)}, but {_one(expected)} in {si_unit!r} (or its multiples) is "
            "needed"
        )
    return Fraction(str(factor)) / Fraction(str(si))


def parse_quantity(value: object, unit: str, bare: bool = False) -> float:
    """The number, in `unit`, of a quantity written as text with a unit or as a plain number.

    Parameters
    ----------
    value : str, int or float
        "0.1 in", "7 ms", 0.1 (already in `unit`)
    unit : str
        what the result is in, e.g. "m", "ns"
    bare : bool
        text without a unit is in `unit`, as in an option of a command, which is always text

    Returns
    -------
    float
        in `unit`

    Raises
    ------
    UsageError
        not a number, not finite, unknown unit, wrong dimension, or text without a unit: a number other than
        0 of a quantity with a dimension

    Examples
    --------
    >>> from surffollow.units import parse_quantity
    >>> parse_quantity("0.1 in", "m"), parse_quantity(7, "ns")
    (0.00254, 7.0)
    """
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise UsageError(f"{value!r} is no quantity; write a number or text like '5 {unit}'")
    if isinstance(value, str):
        match = _QUANTITY.match(value) if len(value) <= MAX_CHARACTERS else None
        if match is None:
            text = f"{value!r}" if len(value) <= MAX_CHARACTERS else f"a text of {len(value)} characters"
            raise UsageError(f"{text} is no quantity; write a number and a unit, like '5 {unit}'")
        number = float(match[1])
        if match[2]:
            scale = _exact_scale(match[2], unit)
            # a number that a float can hold has a fraction of bounded size
            if number != 0.0 and math.isfinite(number):
                number = _rounded(Fraction(match[1]) * scale)
        elif number != 0.0 and not bare and _UNITS[unit][0] != "number":
            usual = f"{match[1]} {_USUAL.get(unit, unit)}"
            raise UsageError(
                f"{value!r} has no unit; write one, like '{usual}', or {match[1]} without quotes for {unit}"
            )
    else:
        try:
            number = float(value)
        except OverflowError:
            raise UsageError("the number is beyond 1.8e308, the largest one; give a smaller one") from None
    if not math.isfinite(number):
        raise UsageError(f"{value!r} is not a finite quantity")
    return number


def _rounded(number: Fraction) -> float:
    """The nearest float; infinite beyond the largest one."""
    try:
        return float(number)
    except OverflowError:
        return math.inf


def real_number(value: object, name: str) -> float:
    """An argument that must be a real number, as float.

    Parameters
    ----------
    value : object
        what the caller gave
    name : str
        of the argument, for the text of the error

    Returns
    -------
    float
        NaN and infinity included

    Raises
    ------
    UsageError
        text, a truth value, a complex number, or nothing that is a number

    Examples
    --------
    >>> from surffollow.units import real_number
    >>> real_number(1, "horizon_s")
    1.0
    """
    try:
        if isinstance(value, (str, bytes, bool, complex)):
            raise TypeError
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise UsageError(f"{name} is {value!r}; it must be a number") from None


def decimal_number(text: str) -> float:
    """The number that a cell of a table says; NaN and infinity included.

    Parameters
    ----------
    text : str
        a decimal number; spaces around it do not matter

    Returns
    -------
    float
        nearest number

    Raises
    ------
    ValueError
        no number; one with underscores, too, which Python takes for groups of digits

    Examples
    --------
    >>> from surffollow.units import decimal_number
    >>> decimal_number("15.0"), decimal_number("1e-3")
    (15.0, 0.001)
    """
    if "_" in text:
        raise ValueError(f"{text!r} is no decimal number")
    return float(text)


def numbers_text(*values: float, digits: int = 6) -> str:
    """Numbers for people: some significant digits, but thousandths of any coordinate or time.

    Parameters
    ----------
    values : float
        in a unit of which a thousandth is enough, such as m or s
    digits : int
        significant digits, where they are more than that

    Returns
    -------
    str
        shortest texts with these digits, and commas between them

    Examples
    --------
    >>> from surffollow.units import numbers_text
    >>> numbers_text(0.123456789), numbers_text(512345.25, 5812345.0)
    ('0.123457', '512345.25, 5812345')
    """

    def text(v: float) -> str:
        if not 10.0 ** (digits - 3) <= abs(v) < 1e15:
            return f"{v:.{digits}g}"
        return f"{v:.3f}".rstrip("0").rstrip(".")

    return ", ".join(map(text, values))


def length_unit(standoff_m: float) -> tuple[float, str]:
    """The one unit of all lengths that are shown beside a stand-off: mm below 1 m, else m.

    Parameters
    ----------
    standoff_m : float
        stand-off, or another length that tells the scale [m]

    Returns
    -------
    factor : float
        from m to the unit
    unit : str
        its name

    Examples
    --------
    >>> from surffollow.units import length_unit
    >>> length_unit(0.1), length_unit(5.0)
    ((1000.0, 'mm'), (1.0, 'm'))
    """
    return (1e3, "mm") if abs(standoff_m) < 1.0 else (1.0, "m")


def is_bare(value: object) -> bool:
    """Whether a quantity, as `parse_quantity` takes it, is a number without a unit.

    Parameters
    ----------
    value : object
        a quantity

    Returns
    -------
    bool
        True for 2 and "2"

    Examples
    --------
    >>> from surffollow.units import is_bare
    >>> is_bare(2), is_bare("2"), is_bare("2 s")
    (True, True, False)
    """
    is_text = isinstance(value, str) and len(value) <= MAX_CHARACTERS
    match = _QUANTITY.match(str(value)) if is_text else None
    return match is None or not match[2]


def format_ns(t_ns: float) -> str:
    """A duration as text: 850 ns, 12.3 µs, 4.56 ms, 1.20 s.

    Parameters
    ----------
    t_ns : float
        duration [ns]

    Returns
    -------
    str
        three digits and a unit; from 1000 s on whole seconds

    Examples
    --------
    >>> from surffollow.units import format_ns
    >>> format_ns(850), format_ns(4_560_000)
    ('850 ns', '4.56 ms')
    """
    for scale, unit in ((1.0, "ns"), (1e3, "µs"), (1e6, "ms")):
        if abs(t_ns) < 999.5 * scale:  # 999.5 has three digits as 1000
            return f"{t_ns / scale:.3g} {unit}"
    seconds = t_ns / 1e9
    return f"{seconds:.3g} s" if abs(seconds) < 999.5 else f"{seconds:.0f} s"
