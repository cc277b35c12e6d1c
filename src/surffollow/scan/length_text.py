"""Lengths of a scan as text."""

from __future__ import annotations


def decimal_length(length_m: float, unit: tuple[float, str]) -> str:
    """A length as text, to a tenth of a millimetre or, in metres, to a millimetre.

    Parameters
    ----------
    length_m : float
        length [m]
    unit : (float, str)
        unit of `surffollow.units.length_unit`

    Returns
    -------
    str
        number and unit

    Examples
    --------
    >>> from surffollow.scan.length_text import decimal_length
    >>> from surffollow.units import length_unit
    >>> decimal_length(0.0523, length_unit(0.1)), decimal_length(1.9867, length_unit(2.0))
    ('52.3 mm', '1.987 m')
    """
    factor, name = unit
    return f"{factor * length_m:.{1 if name == 'mm' else 3}f} {name}"
