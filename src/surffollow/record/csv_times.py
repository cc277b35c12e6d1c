"""Dates and times of a CSV log (ISO 8601) as seconds since 1970, digit for digit, and back."""

from __future__ import annotations

import re
from datetime import datetime, timedelta, timezone

from surffollow.units import numbers_text

ISO_UNIT = "iso8601"  # the `[time] unit` of such a column
_ISO = re.compile(
    r"(\d{4})([-/])(\d\d)\2(\d\d)[T ]+(\d\d):(\d\d):(\d\d)(?:[.,](\d+))?\s*(?:Z|UTC|([-+])(\d\d):?(\d\d))?",
    re.I,
)
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)


def date_text(seconds: float) -> str:
    """Seconds since 1970 as a date with a time in UTC, to a millisecond; as a number beyond the year 9999."""
    try:
        at = _EPOCH + timedelta(milliseconds=round(1e3 * seconds))
    except OverflowError:
        return f"{numbers_text(seconds)} s"
    text = at.replace(tzinfo=None).isoformat(timespec="milliseconds")
    return text.removesuffix(".000") + "Z"


def seconds_text(cell: str) -> str | None:
    """A date with a time as the text of its seconds since 1970 UTC; None: it is none.

    Without a zone it is UTC. The fraction keeps all its digits.
    """
    found = _ISO.fullmatch(cell)
    if found is None:
        return None
    year, _, month, day, hour, minute, second, fraction, sign, zone_h, zone_min = found.groups()
    try:
        at = datetime(
            int(year), int(month), int(day), int(hour), int(minute), int(second), tzinfo=timezone.utc
        )
    except ValueError:
        return None
    offset = timedelta(hours=int(zone_h or 0), minutes=int(zone_min or 0))
    whole = (at - (-offset if sign == "-" else offset) - _EPOCH) // timedelta(seconds=1)
    if whole < 0:  # a fraction would count the other way
        return None
    return f"{whole}.{fraction}" if fraction else f"{whole}"
