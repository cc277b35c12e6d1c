"""Names of commands before release 0.1.0: they work for one release, and `--help` does not list them."""

from __future__ import annotations

import copy

import click

VERBS = {"contest": "benchmark", "header": "print-header", "robot": "simulate"}


def old_name(group: click.Group, command: click.Command, name: str) -> None:
    """Let a group's command answer to an old name, too.

    Parameters
    ----------
    group : click.Group
    command : click.Command
    name : str
        the old name
    """
    hidden = copy.copy(command)
    hidden.hidden = True
    group.add_command(hidden, name)
