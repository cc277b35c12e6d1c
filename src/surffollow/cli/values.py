"""Option types that several verbs share: names of services, and numbers that are numbers."""

from __future__ import annotations

import math
from typing import Any

import click


class ServiceName(click.ParamType):  # type: ignore[type-arg]  # generic only in click 8.3's stubs
    """A name that a service can have."""

    name = "NAME"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Check it, or fail with what is wrong with it."""
        from surffollow.config.names import check_service_name
        from surffollow.errors import NameError_

        try:
            return check_service_name(value)
        except NameError_ as error:
            self.fail(str(error), param, ctx)


class Finite(click.FloatRange):
    """A number between bounds; NaN and infinity, which pass any comparison or none, are refused."""

    name = "NUMBER"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Convert and check, or fail with what was expected."""
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = 0.0  # said below
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number", param, ctx)
        return float(super().convert(value, param, ctx))


SERVICE_NAME = ServiceName()
