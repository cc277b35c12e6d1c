"""Option types and options that several verbs share: names of services, and numbers that are numbers."""

from __future__ import annotations

import errno
import math
import os
import re
from collections.abc import Callable
from typing import Any

import click


class ServiceName(click.ParamType):  # type: ignore[type-arg]  # generic only in click 8.3's stubs
    """A name that a service can have."""

    name = "NAME"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Check it, or fail with what is wrong with it."""
        from surffollow.config.names import check_service_name
        from surffollow.errors import InvalidNameError

        try:
            return check_service_name(value)
        except InvalidNameError as error:
            self.fail(str(error), param, ctx)


class InputFile(click.Path):  # type: ignore[type-arg]  # generic only in click 8.3's stubs
    """A file to read. One that is not there, or is none, is a fault (exit code 1) and no wrong usage.

    `streams` : pipes and devices may be read, too.
    """

    def __init__(self, path_type: type | None = None, *, streams: bool = False) -> None:
        super().__init__(dir_okay=False, readable=False, path_type=path_type)
        self._streams = streams

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path; raises InputFileError."""
        from surffollow.config.input_file import check_plain_file
        from surffollow.errors import InputFileError

        try:
            os.stat(value)
            reason = None if os.access(value, os.R_OK) else os.strerror(errno.EACCES)
        except OSError as error:
            reason = error.strerror
        if reason is not None:
            raise InputFileError(f"cannot read {os.fspath(value)!r}: {reason}")
        if not self._streams or os.path.isdir(value):
            check_plain_file(value)
        return self.coerce_path_result(value)


class OutputFile(click.Path):  # type: ignore[type-arg]  # generic only in click 8.3's stubs
    """A file to write. A folder in its place is a fault (exit code 1) and no wrong usage."""

    def __init__(self, path_type: type | None = None) -> None:
        super().__init__(dir_okay=False, path_type=path_type)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path; raises FaultError."""
        from surffollow.errors import FaultError

        if os.path.isdir(value):
            raise FaultError(f"cannot write {value}: it is a folder; choose another name")
        return self.coerce_path_result(value)


class OutputFolder(click.Path):  # type: ignore[type-arg]  # generic only in click 8.3's stubs
    """A folder to write into. A file in its place is a fault (exit code 1) and no wrong usage."""

    def __init__(self, path_type: type | None = None) -> None:
        super().__init__(file_okay=False, path_type=path_type)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path; raises FaultError."""
        from surffollow.errors import FaultError

        if os.path.exists(value) and not os.path.isdir(value):
            raise FaultError(f"cannot write into {value}: it is no folder; choose another name")
        return self.coerce_path_result(value)


class SignedArguments(click.Command):
    """A command whose arguments are numbers: -0.5 is one of them, for no option begins with a digit."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Hide the sign of numbers, which click takes for the dash of an option, behind a space."""
        return super().parse_args(ctx, [f" {a}" if re.match(r"-\.?\d", a) else a for a in args])


class Finite(click.FloatRange):
    """A number between bounds; NaN and infinity, which pass any comparison or none, are refused."""

    name = "NUMBER"

    def _describe_range(self) -> str:
        # click writes "x<=None" where there are no bounds
        return "" if self.min is None and self.max is None else super()._describe_range()

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Convert and check, or fail with what was expected."""
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = 0.0  # said below
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number", param, ctx)
        return float(super().convert(value, param, ctx))


class LogTime(Finite):
    """A time of a CSV log: seconds, or a date with a time as in a log that has dates."""

    name = "TIME"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Seconds of the log, or fail with what was expected."""
        from surffollow.record.csv_times import seconds_text

        date = seconds_text(value) if isinstance(value, str) else None
        return super().convert(value if date is None else date, param, ctx)


class Amount(click.ParamType):  # type: ignore[type-arg]  # generic only in click 8.3's stubs
    """A positive number with a unit, such as `100MB` or `10min`; a bare number is in the SI unit."""

    def __init__(self, name: str, scales: dict[str, float]) -> None:
        self.name, self._scales = name, scales

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """The number in the SI unit, or fail with the units that there are."""
        if isinstance(value, float):
            return value
        text = str(value).strip()
        unit = text.lstrip("0123456789.eE+-").strip()
        digits = text[: len(text) - len(unit)].strip() if unit else text
        try:
            number = float(digits) * (self._scales[unit] if unit else 1.0)
        except (ValueError, KeyError):
            number = math.nan
        if not 0.0 < number < math.inf:
            units = ", ".join(self._scales)
            self.fail(f"{value!r} is not a positive number with one of the units {units}", param, ctx)
        return number


class Quantity(click.ParamType):  # type: ignore[type-arg]  # generic only in click 8.3's stubs
    """A number with a unit of one dimension, such as `0.1in` or `2.54 mm`; a bare number is in `unit`.

    `above` : what it has to exceed, in `unit`.
    """

    def __init__(self, name: str, unit: str, above: float = -math.inf) -> None:
        self.name, self.unit, self.above = name, unit, above

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """The number in `unit`, or fail with what was expected."""
        from surffollow.errors import UsageError
        from surffollow.units import parse_quantity

        try:
            number = value if isinstance(value, float) else parse_quantity(str(value), self.unit, bare=True)
        except UsageError as error:
            self.fail(str(error), param, ctx)
        if not number > self.above:
            self.fail(f"{number:g} {self.unit}; expected more than {self.above:g}", param, ctx)
        return number


def rate_option(text: str) -> Callable[[Any], Any]:
    """Option --rate of the commands that write samples of a recording."""
    kind = Finite(min=0.0, max=10_000.0)
    return click.option("--rate", type=kind, default=100.0, show_default=True, help=text)


COLUMNS = click.option(
    "--columns", type=InputFile(streams=True), help="FILE is a CSV log: what its columns mean (TOML)."
)
JSON = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
SERVICE_NAME = ServiceName()
LENGTH = Quantity("LENGTH", "m")
POSITIVE_LENGTH = Quantity("LENGTH", "m", above=0.0)
SIZE = Amount(
    "SIZE", {"B": 1.0, "kB": 1e3, "MB": 1e6, "GB": 1e9, "KiB": 1024.0, "MiB": 2.0**20, "GiB": 2.0**30}
)
DURATION = Amount("TIME", {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0, "ms": 1e-3})
