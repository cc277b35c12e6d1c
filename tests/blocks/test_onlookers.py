"""Programs that have never seen a block's schema: the command line, and C."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

import surffollow
from second_user import NOBODY, as_other_user, needs_root
from surffollow.blocks import I8, Block, listing, mem_attach
from surffollow.blocks.cheader import c_header
from surffollow.blocks.layout import schema_from_text, schema_text
from surffollow.blocks.remove import remove_block
from surffollow.cli.blocks import blocks_group
from surffollow.errors import BlockError, BusyError, NoPermissionError, NotRunningError, SchemaError

from .conftest import Platform, Words, forever

INCLUDE = Path(surffollow.__file__).parent / "include"


def run(*args: str) -> str:
    result = CliRunner().invoke(blocks_group, args, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture
def platform(space):
    with mem_attach(Platform, space, write=True) as mem:
        with mem.platform.write() as slot:
            slot.update(t_ns=5, pose=(1.5, 2, 3), state="home")
            slot.wheel[1].speed = 0.25
        yield mem.platform


def test_a_schema_survives_its_own_text():
    for schema in (Platform, Words):
        again = schema_from_text(schema_text(schema))
        assert again.HASH == schema.HASH
        assert again.describe() == schema.describe()
        assert again.field(schema.FIELDS[0].name).doc == schema.FIELDS[0].doc
    for text in ("", "[]", "{}", '{"schema":"X","fields":[{"name":"a","type":"zz","count":1}]}', "null"):
        with pytest.raises(SchemaError):
            schema_from_text(text)


class Odd(Block):
    """Its unit and doc would end a comment, or a line."""

    x = I8(unit="m */ int y;", doc="a\nb\x1b[2J */")


def test_units_and_docs_end_no_comment_and_no_line(space):
    text = c_header(Odd)
    (member,) = [line for line in text.splitlines() if "int8_t x;" in line]
    assert member.count("*/") == 1
    assert member.endswith("*/")
    assert member.count("/*") == 1
    assert "\x1b" not in text
    with mem_attach(Odd, space, write=True) as mem:
        with mem.odd.write() as slot:
            slot.x = 1
        shown = run("show", f"{space}.odd")
    (line,) = [line for line in shown.splitlines() if "x [" in line]
    assert line.endswith(r"= 1    a\nb\x1b[2J */")


def test_ls_names_every_block_its_writer_and_its_age(space, platform):
    mine = [b for b in json.loads(run("ls", "--json")) if b["name"].startswith(space)]
    assert len(mine) == 1
    assert mine[0]["schema"] == "Platform"
    assert mine[0]["writer_alive"]
    assert mine[0]["generation"] == 1
    assert f"{space}.platform" in run("ls")
    platform.close(keep=True)
    assert "(dead)" in next(line for line in run("ls").splitlines() if line.startswith(space))


@needs_root
def test_ls_names_a_block_that_its_user_may_not_read(space, platform):
    name = f"{space}.platform"
    os.chmod(f"/dev/shm/{name}", 0o600)
    listed = as_other_user(lambda _: run("ls", "--json"))
    assert {"name": name, "readable": False, "owner": 0} in json.loads(listed)
    text = as_other_user(lambda _: run("ls"))
    assert "not readable, perhaps blocks: " in text
    assert f"{name} (user 0)" in text
    assert "no blocks" not in text


def test_show_prints_values_with_units_from_the_block_itself(space, platform):
    text = run("show", f"{space}.platform")
    assert "pose [m, m, rad] = [1.5, 2, 3]" in text
    assert "t_ns [ns] = 5    when it was true" in text
    assert "speed [rad/s] = 0.25" in text
    shown = json.loads(run("show", f"{space}.platform", "--json"))
    assert shown["values"]["wheel"][1] == {"speed": 0.25, "slips": 0}
    assert shown["fields"][0]["unit"] == "ns"


def test_show_prints_a_surveys_coordinates_to_a_millimetre(space, platform):
    with platform.write() as slot:
        slot.pose = (512345.6789, 5812345.6789, 0.123456789)
    assert "= [512345.679, 5812345.679, 0.123456789]" in run("show", f"{space}.platform")


def test_watch_prints_each_change_it_sees(space, platform):
    words = [sys.executable, "-m", "surffollow", "blocks", "watch", f"{space}.platform", "--json"]
    with subprocess.Popen([*words, "--every", "0.005", "--count", "2"], stdout=subprocess.PIPE) as watch:
        lines = [watch.stdout.readline()]
        with platform.write() as slot:
            slot.t_ns = 6
        lines += watch.stdout.readlines()
    assert [json.loads(line)["values"]["t_ns"] for line in lines] == [5, 6]
    assert "state='home'" in run("watch", f"{space}.platform", "--count", "1")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_watch_ends_quietly_on_a_signal(space, platform, number):
    words = [sys.executable, "-m", "surffollow", "blocks", "watch", f"{space}.platform"]
    pipe = subprocess.PIPE
    with subprocess.Popen([*words, "--every", "5"], stdout=pipe, stderr=pipe) as watch:
        watch.stdout.readline()
        watch.send_signal(number)
        assert watch.communicate(timeout=60) == (b"", b"")
    assert watch.returncode == 0


def test_an_event_that_a_handler_sets_while_its_own_thread_waits_ends_the_wait():
    """GIVEN a thread inside `wait` at whatever line WHEN a signal sets the event THEN the wait ends."""
    code = """
import signal
from surffollow.cli.progress import stop_event
for k in range(400):
    stop = stop_event()
    signal.signal(signal.SIGALRM, lambda *_: stop.set())
    signal.setitimer(signal.ITIMER_REAL, 5e-6 + 2e-7 * k)
    while not stop.wait(60.0):
        pass
print("done")
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout == "done\n"


def no_constant(text: str) -> None:
    raise AssertionError(f"{text} is no JSON")


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_values_that_json_does_not_know_are_null(space, platform, value):
    with platform.write() as slot:
        slot.pose = (value, 2.0, 3.0)
    for words in (["show"], ["watch", "--count", "1"]):
        text = run(words[0], f"{space}.platform", "--json", *words[1:])
        assert json.loads(text, parse_constant=no_constant)["values"]["pose"] == [None, 2.0, 3.0]


def test_what_is_no_block_is_said_to_be_none(space):
    runner = CliRunner()
    assert isinstance(runner.invoke(blocks_group, ["show", f"{space}.none"]).exception, NotRunningError)
    Path("/dev/shm", f"{space}.junk").write_bytes(bytes(16384))
    assert isinstance(runner.invoke(blocks_group, ["show", f"{space}.junk"]).exception, BlockError)
    assert space not in run("ls")


_READER = """
#include "blocks.h"
int main(int argc, char **argv) {
  sfb_block block;
  sfb_platform p;
  int64_t t_ns = 0, generation;
  int err = sfb_open(&block, argc > 1 ? argv[1] : "", SFB_PLATFORM_HASH, sizeof p);
  if (err < 0) { printf("%d\\n", err); return 0; }
  generation = sfb_latest(&block, &p, &t_ns);
  printf("%lld %lld %g %g %s %d %d\\n", (long long)generation, (long long)p.t_ns, p.pose[0], p.wheel[1].speed,
         p.state, t_ns > 0, sfb_given_up(&block));
  sfb_close(&block);
  return 0;
}
"""


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
@pytest.mark.parametrize("language", ["c11", "c++17"])
def test_the_c_header_of_a_schema_reads_the_block(space, platform, tmp_path, language):
    class Bits(Block):
        """An odd size."""

        flags = I8(3)

    (tmp_path / "blocks.h").write_text(c_header([Platform, Bits]))
    source = tmp_path / ("reader.c" if language == "c11" else "reader.cpp")
    source.write_text(_READER)
    flags = ["-O1", f"-std={language}", "-Wall", "-Wextra", "-Werror", "-pedantic", f"-I{INCLUDE}"]
    compiler = "cc" if language == "c11" else "c++"
    subprocess.run([compiler, *flags, str(source), "-o", str(tmp_path / "reader"), "-lrt"], check=True)

    def read(name: str) -> str:
        return subprocess.run(
            [str(tmp_path / "reader"), name], check=True, capture_output=True, text=True
        ).stdout.strip()

    assert read(f"{space}.platform") == "1 5 1.5 0.25 home 1 0"
    assert read(f"{space}.none") == "-2"
    assert read("../etc/passwd") == "-22"
    with mem_attach(Words, space, write=True):
        assert read(f"{space}.words") == "-71"
    assert "typedef struct sfb_platform" in run("print-header", f"{space}.platform")


def test_rm_removes_the_block_of_a_dead_writer_only(space, child):
    def write(me):
        with mem_attach(Platform, space, write=True).platform.write() as slot:
            slot.t_ns = 1
        me.say(1)
        forever()

    name, path = f"{space}.platform", Path(f"/dev/shm/{space}.platform")
    # GIVEN a block whose writer lives
    writer = child(write)
    assert writer.receive() == 1
    reader = mem_attach(Platform, space).platform
    with pytest.raises(BusyError, match=str(writer.pid)):
        remove_block(name)
    # nor is it removed where the lock of its writer was removed manually
    Path(f"{path}.lock").unlink()
    with pytest.raises(BusyError, match=str(writer.pid)):
        remove_block(name)
    # WHEN the writer is killed and its block removed
    writer.kill()
    assert json.loads(run("rm", name, "--json")) == {"removed": [name]}
    # THEN nothing is left of it, and readers know
    assert not list(Path("/dev/shm").glob(f"{space}*"))
    assert reader.latest().stale
    with pytest.raises(NotRunningError):
        remove_block(name)
    assert not list(Path("/dev/shm").glob(f"{space}*"))


def test_rm_removes_no_other_object(space):
    path = Path(f"/dev/shm/{space}.platform")
    path.write_bytes(bytes(8192))
    with pytest.raises(BlockError, match="is no block"):
        remove_block(path.name)
    assert path.exists()


@needs_root
def test_rm_removes_no_block_of_another_user(space):
    mem_attach(Platform, space, write=True).close(keep=True)
    path = Path(f"/dev/shm/{space}.platform")
    os.chown(path, NOBODY, NOBODY)
    with pytest.raises(NoPermissionError):
        remove_block(path.name)
    assert path.exists()


def test_a_folder_of_blocks_that_cannot_be_listed_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(listing, "SHM_ROOT", tmp_path / "none")
    for listed in (listing.list_blocks, listing.unreadable_objects):
        with pytest.raises(NoPermissionError, match=r"cannot list .*/none: No such file.*; its usual mode"):
            listed()
