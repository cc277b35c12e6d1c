"""`surffollow print-header`: the C header, its pkg-config data, and the layout as JSON."""

from __future__ import annotations

import json
import re
from pathlib import Path

import click

from surffollow.cli.option_types import OutputFolder
from surffollow.release import program_version

HEADER = Path(__file__).parents[1] / "include" / "surffollow.h"
HEADERS = (HEADER, HEADER.with_name("surffollow_arbiter.h"))

PKG_CONFIG = """\
includedir={includedir}

Name: surffollow
Description: Client of the surffollow real-time surface following service (header only)
Version: {version}
Cflags: -I${{includedir}}
"""


def pkg_config_text(includedir: str) -> str:
    """The text of `surffollow.pc` for a header in that directory."""
    # pkg-config takes words apart as a shell does; a dollar without a brace is one
    escaped = re.sub(r"([^\w/.,:+@%=~$-])", r"\\\1", includedir)
    return PKG_CONFIG.format(includedir=escaped, version=program_version())


@click.command("print-header")
@click.option("--cflags", is_flag=True, help="Print the compiler's option that finds the header.")
@click.option("--pkg-config", is_flag=True, help="Print surffollow.pc for the header where it is now.")
@click.option("--json", "as_json", is_flag=True, help="Print the layout for clients in other languages.")
@click.option(
    "--install",
    "prefix",
    type=OutputFolder(Path),
    help="Copy it and the arbiter's to PREFIX/include, and write PREFIX/lib/pkgconfig/surffollow.pc.",
)
def print_header_command(cflags: bool, pkg_config: bool, as_json: bool, prefix: Path | None) -> None:
    """Print the C header of the client library (C99, C++17, nothing to link), or the layout as JSON."""
    if sum((cflags, pkg_config, as_json, prefix is not None)) > 1:
        raise click.UsageError("--cflags, --pkg-config, --json and --install exclude each other")
    if prefix is not None:
        install(prefix)
    elif as_json:
        from surffollow.shm.layout_json import layout_document

        click.echo(json.dumps(layout_document(), indent=2, allow_nan=False))
    elif cflags:
        click.echo(f"-I{HEADER.parent}")
    elif pkg_config:
        click.echo(pkg_config_text(str(HEADER.parent)), nl=False)
    else:
        click.echo(HEADER.read_text(encoding="ascii"), nl=False)


def install(prefix: Path) -> None:
    """Put headers and pkg-config file under a prefix, such as /usr/local."""
    includedir = prefix.absolute() / "include"
    pkg_config = prefix / "lib" / "pkgconfig"
    try:
        includedir.mkdir(parents=True, exist_ok=True)
        pkg_config.mkdir(parents=True, exist_ok=True)
        for header in HEADERS:
            (includedir / header.name).write_bytes(header.read_bytes())
        (pkg_config / "surffollow.pc").write_text(pkg_config_text(str(includedir)), encoding="utf-8")
    except OSError as e:
        raise click.ClickException(f"cannot write to {prefix}: {e.strerror}") from None
    for path in (*(includedir / header.name for header in HEADERS), pkg_config / "surffollow.pc"):
        click.echo(path)
