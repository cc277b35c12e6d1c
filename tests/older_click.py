"""Capture with click 8.1 as later versions do: stdout and stderr apart, and both in `output`."""

from __future__ import annotations

import contextlib
import functools
import inspect
import sys
from collections.abc import Iterator
from typing import Any

from click.testing import CliRunner, Result

_isolation = CliRunner.isolation


@contextlib.contextmanager
def _written_through(runner: CliRunner, *words: Any, **named: Any) -> Iterator[Any]:
    """`CliRunner.isolation`; 8.1 reads stderr before its buffer is written."""
    with _isolation(runner, *words, **named) as streams:
        sys.stderr.reconfigure(write_through=True)
        yield streams


def capture_as_later_versions() -> None:
    """Change click's runner where it is that of 8.1."""
    if "mix_stderr" in inspect.signature(CliRunner).parameters:
        CliRunner.__init__ = functools.partialmethod(CliRunner.__init__, mix_stderr=False)
        CliRunner.isolation = _written_through
        Result.output = property(lambda result: result.stdout + result.stderr)
