"""`surffollow header`: the C header, where it lies, and what pkg-config wants to know about it."""

from __future__ import annotations

import re
from importlib.metadata import version
from pathlib import Path

import click

HEADER = Path(__file__).parents[1] / "include" / "surffollow.h"

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
    return PKG_CONFIG.format(includedir=escaped, version=version("surffollow"))


@click.command("header")
@click.option("--cflags", is_flag=True, help="Print the compiler's option that finds the header.")
@click.option("--pkg-config", is_flag=True, help="Print surffollow.pc for the header where it is now.")
@click.option(
    "--install",
    "prefix",
    type=click.Path(file_okay=False, path_type=Path),
    help="Copy to PREFIX/include and write PREFIX/lib/pkgconfig/surffollow.pc.",
)
def header_command(cflags: bool, pkg_config: bool, prefix: Path | None) -> None:
    """Print the C header of the client library (C11, C++17, nothing to link)."""
    if sum((cflags, pkg_config, prefix is not None)) > 1:
        raise click.UsageError("--cflags, --pkg-config and --install exclude each other")
    if prefix is not None:
        install(prefix)
    elif cflags:
        click.echo(f"-I{HEADER.parent}")
    elif pkg_config:
        click.echo(pkg_config_text(str(HEADER.parent)), nl=False)
    else:
        click.echo(HEADER.read_text(encoding="ascii"), nl=False)


def install(prefix: Path) -> None:
    """Put header and pkg-config file under a prefix, such as /usr/local."""
    includedir = prefix.absolute() / "include"
    pkg_config = prefix / "lib" / "pkgconfig"
    try:
        includedir.mkdir(parents=True, exist_ok=True)
        pkg_config.mkdir(parents=True, exist_ok=True)
        (includedir / HEADER.name).write_bytes(HEADER.read_bytes())
        (pkg_config / "surffollow.pc").write_text(pkg_config_text(str(includedir)), encoding="utf-8")
    except OSError as e:
        raise click.ClickException(f"cannot write to {prefix}: {e.strerror}") from None
    click.echo(f"{includedir / HEADER.name}\n{pkg_config / 'surffollow.pc'}")
