"""Every option of every command says what it sets, in a phrase with its noun."""

from __future__ import annotations

from collections.abc import Iterator

import click

from surffollow.cli.main import cli


def commands(group: click.Group, path: str = "") -> Iterator[tuple[str, click.Command]]:
    """All commands below a group, with their paths."""
    ctx = click.Context(group)
    for name in group.list_commands(ctx):
        command = group.get_command(ctx, name)
        assert command is not None
        if isinstance(command, click.Group):
            yield from commands(command, f"{path}{name} ")
        yield path + name, command


def test_every_option_has_a_text_that_begins_with_its_noun() -> None:
    texts = {
        f"{path} {option.opts[0]}": option.help or ""
        for path, command in commands(cli)
        for option in command.params
        if isinstance(option, click.Option) and not option.hidden
    }
    assert len(texts) > 200
    assert [
        name for name, text in texts.items() if not text or text.startswith(("Of ", "So many", "Along "))
    ] == []
