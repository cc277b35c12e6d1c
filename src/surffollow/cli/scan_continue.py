"""Where a scan run begins along its path, and the command that continues one that was aborted."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from surffollow.errors import UsageError
from surffollow.units import parse_quantity

if TYPE_CHECKING:
    from surffollow.scan.path import ScanPath

OWN_OUTPUTS = ("begin", "picture", "report")  # options that the continued run cannot share


class PathTime(click.ParamType):  # type: ignore[type-arg]  # generic only in click 8.3's stubs
    """A time along a path, and the digest of that path or ""."""

    name = "TIME[@ID]"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, str]:
        """Seconds and digest, or fail with what was expected."""
        if isinstance(value, tuple):
            return value
        text, at, digest = str(value).partition("@")
        if at and not digest:
            self.fail(f"{value!r} has no path's ID after the @", param, ctx)
        try:
            return parse_quantity(text, "s", bare=True), digest
        except UsageError as error:
            self.fail(str(error), param, ctx)


def begin_of(planned: ScanPath, path: str, begin: tuple[float, str] | None) -> float:
    """Time along a path where a run is to begin [s]; it has to be one of this path."""
    from surffollow.apps.scan_parts import check_begin, path_id

    if begin is None:
        return 0.0
    begin_s, digest = begin
    own = path_id(planned)
    if digest and digest != own:
        raise click.UsageError(
            f"--from continues a run of the path with the ID {digest}, but {path} has the ID {own}: give the "
            "path of that run"
        )
    check_begin(planned, begin_s)
    return begin_s


def begin_text(planned: ScanPath, begin_s: float) -> str:
    """Where a run begins that does not begin at the first sample."""
    import numpy as np

    t = planned.t_s - planned.t_s[0]
    x, y = (float(np.interp(begin_s, t, planned.position_m[:, k])) for k in range(2))
    number = int(planned.passes[int(np.searchsorted(t, begin_s, side="right")) - 1])
    where = f"pass {number + 1} of {int(planned.passes.max()) + 1}" if number >= 0 else "a turn"
    return f"begins at {begin_s:.3f} s of {t[-1]:.3f} s, {where}, x {x:.3f}, y {y:.3f} m"


def continuing_command(ctx: click.Context, place: str) -> str:
    """The command line of this run with another begin, and without the files that it has written."""
    words = ["surffollow"]
    owner = ctx.find_root()
    if owner.get_parameter_source("owner") == ParameterSource.COMMANDLINE:
        words += ["--owner", str(owner.params["owner"])]
    words += ["scan", "run", str(ctx.params["path"]), "--from", place]
    for param in ctx.command.params:
        given = ctx.get_parameter_source(str(param.name)) == ParameterSource.COMMANDLINE
        if not given or not isinstance(param, click.Option) or param.name in OWN_OUTPUTS:
            continue
        words.append(param.opts[0])
        if not param.is_flag:
            words.append(str(ctx.params[str(param.name)]))
    return shlex.join(words)
