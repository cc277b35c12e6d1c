"""Pages of docs/reference that are generated as a whole: the command line and the C interface."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import click

from surffollow.blocks.cheader import reader_text
from surffollow.blocks.cwriter import writer_text
from surffollow.cli.main import cli

INCLUDE = Path(__file__).parents[1] / "src" / "surffollow" / "include"
# structures that a controller handles; those of shared memory are in the layout
C_STRUCTURES = ("sf_demand", "sf_client", "sf_options", "sf_status_info", "sf_param_info")
RESULT = re.compile(
    r"^  (SF_(?:OK|NO_DEMAND|PENDING|NO_READING|UNKNOWN|ERR_\w+|REFUSED_\w+)) = (-?\d+)", re.MULTILINE
)
FUNCTION = re.compile(
    r"^/\*((?:[^*]|\*(?!/))*)\*/\n^static inline ([^{;]*?\b(sf[ab]?_\w+)\([^{;]*?\))\s*\{", re.MULTILINE
)


def commands(group: click.Group, name: str) -> Iterator[tuple[str, click.Command]]:
    """All commands below a group, with their full names."""
    with click.Context(group, info_name=name) as ctx:
        for word in group.list_commands(ctx):
            command = group.get_command(ctx, word)
            if command is None or command.hidden:
                continue
            yield f"{name} {word}", command
            if isinstance(command, click.Group):
                yield from commands(command, f"{name} {word}")


def cli_page() -> str:
    """`--help` of every command."""
    text = """# Command line

This page is for users of the command line. It has the help text of every command.
`python tools/write_docs.py` writes it from the program.

Exit codes: 0 done, 1 fault, 2 wrong usage, 130 interrupted by Ctrl-C, 141 when standard output is a
closed pipe, such as that of `| head`. Commands that run until Ctrl-C
exit with 0 then. SIGTERM and SIGHUP end the commands that run until Ctrl-C in the same way. They end
`scan run` and a waiting `simulate` with 130, and all other commands in order with 143 and 129.
Before the first line of surffollow, in the 0.03 s in which Python itself starts, Ctrl-C may print a
traceback of Python.

Exit code 2 means that the command line is wrong: an option or argument is unknown, is missing, has a
wrong value, or does not fit the files beside it. Every other fault has exit code 1. That includes:

- an input that is not there, may not be read, or is a folder or an endless device;
- an input with wrong contents, of any format: TOML, CSV, JSON, map, recording, image, path;
- an output that exists already, is a folder or cannot be written.

With `--json` an error is one JSON object on stdout: `error` (its text), `kind` (its class of
`surffollow.errors`) and `exit_code`. The text is on stderr, with `--json` too. `blocks watch` and
`arbiter history` print the object as their last line. An early end by Ctrl-C or a signal is an error of
the kind `KeyboardInterrupt` (`Abort` at a question) or `Terminated`.
"""
    settings = {"terminal_width": 100, "max_content_width": 100, **cli.context_settings}
    for name, command in (("surffollow", cli), *commands(cli, "surffollow")):
        with click.Context(command, info_name=name, **settings) as ctx:  # type: ignore[arg-type]
            text += f"\n## {name}\n\n```text\n{command.get_help(ctx)}\n```\n"
    return text


def functions(header: str, prefix: str) -> Iterator[tuple[str, str, str]]:
    """Public functions of a header's text: name, declaration, comment."""
    seen = set()
    for comment, declaration, name in FUNCTION.findall(header):
        if name in seen or not name.startswith(prefix) or name.startswith(prefix + "i_"):
            continue
        seen.add(name)
        lines = [line.removeprefix(" *").removeprefix(" ").rstrip() for line in comment.splitlines()]
        yield name, " ".join(declaration.split()), "\n".join(lines).strip()


def headers() -> Iterator[tuple[str, str, str]]:
    """Titles and texts of the headers, and how the names of their functions begin."""
    for name, prefix in (("surffollow.h", "sf_"), ("surffollow_arbiter.h", "sfa_")):
        yield name, (INCLUDE / name).read_text(encoding="utf-8"), prefix
    yield "Headers of blocks", reader_text() + writer_text(), "sfb_"


def structure(header: str, name: str) -> str:
    """A structure of the header with its comment, without its private members."""
    found = re.search(
        rf"^/\* ((?:[^*]|\*(?!/))*) \*/\ntypedef struct {name} {{\n(.*?)^}} {name};$",
        header,
        re.MULTILINE | re.DOTALL,
    )
    assert found is not None, name
    members = found[2].split("  /* private */\n")[0].rstrip("\n")
    hidden = "\n  /* ... */" if "/* private */" in found[2] else ""
    comment = " ".join(found[1].split())
    return f"/* {comment} */\ntypedef struct {name} {{\n{members}{hidden}\n}} {name};"


def results(header: str) -> str:
    """Every result of a function, with the sentence of sf_strerror."""
    sentences = dict(re.findall(r'case (SF_\w+): return "([^"]*)";', header))
    body = header.split("sf_answer_text(int answer) {")[1].split("\n}")[0]
    answers = dict(re.findall(r'case (\d+): return "([^"]*)";', body))
    numbers = {name: int(value) for name, value in RESULT.findall(header)}
    texts = {name: sentences.get(name) or answers[str(-100 - number)] for name, number in numbers.items()}
    refused_last = sorted(numbers, key=lambda name: (numbers[name] < 0, abs(numbers[name])))
    return "\n".join(f"{numbers[name]:5} {name}: {texts[name]}" for name in refused_last)


def c_page() -> str:
    """Public functions of the C headers with their comments."""
    text = """# C interface

This page is for programmers of controllers in C and C++. It lists the functions of the two headers,
and those of the headers that `surffollow blocks print-header` prints.
`python tools/write_docs.py` writes it from the headers.

`surffollow --includedir` prints the folder of the headers; there is nothing to link. The structures of
the shared memory are in the [layout](layout.md), the order of calls is in the
[tutorial](../tutorials/c-loop.md).
"""
    header = (INCLUDE / "surffollow.h").read_text(encoding="utf-8")
    text += "\n## Structures of a controller\n\n```c\n"
    text += "\n\n".join(structure(header, name) for name in C_STRUCTURES) + "\n```\n"
    text += "\nThe bits of `status` are in [health and faults](health-and-faults.md#status-of-a-demand).\n"
    text += f"\n## Results\n\nThe sentences are those of `sf_strerror`.\n\n```text\n{results(header)}\n```\n"
    text += """
The `detail` of the client has a number with it: an errno, the pid of a holder, a limit, or a parameter.
`sf_param_table` has the parameters in the order of their numbers, with name and bounds.
"""
    for title, header, prefix in headers():
        text += f"\n## {title}\n"
        for name, declaration, comment in functions(header, prefix):
            text += f"\n### {name}\n\n```c\n{declaration};\n```\n\n```text\n{comment}\n```\n"
    return text
