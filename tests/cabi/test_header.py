"""The committed C header is what the layout declares, in every dialect a controller may be built with."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner

from cabi.running import ROOT, WARNINGS, run
from surffollow.cli.main import cli
from surffollow.client import attachment, demand, pose, push_range, slot_watch
from surffollow.config.params import PARAMS
from surffollow.hw import pushed_ranges
from surffollow.shm import cheader
from surffollow.shm.layout_board import RESULT_TEXT
from surffollow.shm.schema import F64, I64, U8, Nested, Schema, Text

REGENERATE = "run `python -m surffollow.shm.cheader` and commit what it writes"


def test_committed_header_is_the_one_that_the_layout_gives() -> None:
    assert cheader.HEADER.read_text() == cheader.header_text(), REGENERATE
    assert (ROOT / "include/surffollow.h").read_bytes() == cheader.HEADER.read_bytes()


def test_header_is_ascii_so_that_any_compiler_reads_it() -> None:
    cheader.HEADER.read_bytes().decode("ascii")


def dump_of(schemas: tuple[type[Schema], ...]) -> tuple[str, dict[str, int]]:
    """A C program that prints every offset and size, and what it must print."""
    lines, expected = [], {}
    for schema in schemas:
        name = cheader.c_name(schema)
        lines.append(f'printf("{name} %zu\\n", sizeof({name}));')
        expected[name] = schema.SIZE
        for path, at, field in schema.walk():
            lines.append(f'printf("{name}.{path} %zu\\n", offsetof({name}, {path}));')
            expected[f"{name}.{path}"] = at
            lines.append(f'printf("{name}.{path}# %zu\\n", sizeof((({name} *)0)->{path}));')
            expected[f"{name}.{path}#"] = field.size
    body = "\n  ".join(lines)
    return f'#include "surffollow.h"\nint main(void) {{\n  {body}\n  return 0;\n}}\n', expected


@pytest.mark.parametrize("language", ["C", "C++"])
def test_offsets_and_sizes_are_those_of_the_schemas(
    compile_program: Callable[..., Path], language: str
) -> None:
    source, expected = dump_of(cheader.SCHEMAS)
    printed = run(compile_program(source, language=language)).split("\n")
    found = {line.split()[0]: int(line.split()[1]) for line in printed if line}
    assert found == expected
    assert len(found) > 400


def test_structure_of_any_schema_compiles_with_its_assertions(compile_program: Callable[..., Path]) -> None:
    class Inner(Schema):
        """Nested, three bytes."""

        tag = U8(3)

    class UserBlock(Schema):
        """A block that a user declares."""

        flag = U8(doc="ends a comment early: */")
        inner = Nested(Inner, 5)
        value = F64(2, unit="m", align=64)
        name = Text(5)
        stamp = I64()

    text = cheader.c_struct(Inner, "my_") + cheader.c_struct(UserBlock, "my_")
    source = f'#include "surffollow.h"\n{text}int main(void) {{ return 0; }}\n'
    run(compile_program(source))
    run(compile_program(source, language="C++"))


@pytest.mark.parametrize(
    ("compiler", "flags"),
    [
        ("gcc", ["-std=gnu11", "-O3"]),
        ("gcc", ["-std=gnu99", "-O2"]),
        ("gcc", ["-std=c99", "-O2", "-D_POSIX_C_SOURCE=200809L"]),
        ("gcc", ["-std=c17", "-O2", "-ffast-math", "-D_POSIX_C_SOURCE=200809L"]),
        ("g++", ["-std=c++20", "-O2"]),
        ("clang", ["-std=c11", "-O2"]),
        ("aarch64-linux-gnu-gcc", ["-std=c11", "-O2"]),
    ],
    ids=["gnu11", "gnu99", "c99", "c17-fast-math", "c++20", "clang", "aarch64"],
)
def test_header_compiles_without_a_warning(compiler: str, flags: list[str], tmp_path: Path) -> None:
    if shutil.which(compiler) is None:
        pytest.skip(f"no {compiler} on this machine")
    source = tmp_path / ("a.cpp" if "+" in compiler else "a.c")
    source.write_text('#include "surffollow.h"\n#include "surffollow.h"\n')
    command = [compiler, *flags, *WARNINGS, f"-I{ROOT / 'include'}", "-c", str(source), "-o", os.devnull]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_two_files_of_a_program_may_include_the_header(tmp_path: Path) -> None:
    (tmp_path / "a.c").write_text('#include "surffollow.h"\nint b(void);\nint main(void) { return b(); }\n')
    (tmp_path / "b.c").write_text('#include "surffollow.h"\nint b(void) { return sf_alive(NULL); }\n')
    program = tmp_path / "ab"
    files = [str(tmp_path / "a.c"), str(tmp_path / "b.c")]
    subprocess.run(["gcc", "-std=c11", f"-I{ROOT / 'include'}", *files, "-o", str(program)], check=True)
    run(program)


def test_c_and_python_clients_share_their_constants() -> None:
    assert cheader.STALE == demand.STALE
    assert cheader.REATTACH_EVERY_NS == attachment.REATTACH_EVERY_NS
    assert cheader.LOOK_EVERY_NS == slot_watch.LOOK_EVERY_NS
    assert cheader.POSE_FUTURE_NS == pose.FUTURE_NS
    assert cheader.RANGE_FUTURE_NS == push_range.FUTURE_NS <= pushed_ranges.FUTURE_NS
    assert cheader.RANGE_OLDEST_NS == push_range.OLDEST_NS == pushed_ranges.OLDEST_NS


def test_every_result_has_its_text_and_every_parameter_its_bounds(
    compile_program: Callable[..., Path],
) -> None:
    source = """#include "surffollow.h"
    int main(void) {
      for (int r = -140; r < 6; r++) printf("%d %s\\n", r, sf_strerror(r));
      for (int k = 0; k < SF_PARAMS; k++) {
        const sf_param_info *p = &sf_param_table()[k];
        printf("param %s %.17g %.17g\\n", p->name, p->low, p->high);
      }
      return 0;
    }
    """
    lines = run(compile_program(source)).splitlines()
    texts = {int(line.split(" ", 1)[0]): line.split(" ", 1)[1] for line in lines if line[0] in "-0123456789"}
    named = {r: t for r, t in texts.items() if t != "unknown result"}
    assert len(set(named.values())) == len(named)
    assert set(range(-34, -19)) | set(range(-8, 5)) <= set(named)
    for answer, text in enumerate(RESULT_TEXT):
        if answer > 0:
            assert texts[-100 - answer] == text.replace('"', "'")
    bounds = {line.split()[1]: tuple(map(float, line.split()[2:])) for line in lines if line[:5] == "param"}
    assert bounds == {name: (spec.low, spec.high) for name, spec in PARAMS.items()}


def test_command_prints_the_header_and_the_way_to_it() -> None:
    runner = CliRunner()
    assert runner.invoke(cli, ["print-header"]).output == cheader.HEADER.read_text()
    folder = Path(runner.invoke(cli, ["--includedir"]).output.strip())
    assert (folder / "surffollow.h").is_file()
    assert runner.invoke(cli, ["print-header", "--cflags"]).output.strip() == f"-I{folder}"
    assert runner.invoke(cli, ["print-header", "--cflags", "--pkg-config"]).exit_code == 2


@pytest.mark.parametrize("folder", ["plain", "with a space", 'it\'s $HOME, (5%) "off" #1;\\'])
def test_installed_header_is_found_by_pkg_config(tmp_path: Path, folder: str) -> None:
    tmp_path /= folder
    result = CliRunner().invoke(cli, ["print-header", "--install", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert (tmp_path / "include/surffollow.h").read_bytes() == cheader.HEADER.read_bytes()
    if shutil.which("pkg-config") is None:
        if folder != "plain":
            return
        assert f"includedir={tmp_path}/include" in (tmp_path / "lib/pkgconfig/surffollow.pc").read_text()
        return
    where = os.environ | {"PKG_CONFIG_PATH": str(tmp_path / "lib/pkgconfig")}
    command = ["pkg-config", "--cflags", "surffollow"]
    flags = subprocess.run(command, env=where, capture_output=True, text=True, check=True).stdout
    assert shlex.split(flags) == [f"-I{tmp_path}/include"]
