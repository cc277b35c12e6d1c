"""A writer in C: Python reads what it publishes, one writer at a time, deaths and waiting reads included."""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest

import surffollow
from surffollow.blocks import I64, Block, mem_attach
from surffollow.blocks.cheader import c_header
from surffollow.errors import BusyError

from .conftest import Platform

INCLUDE = Path(surffollow.__file__).parent / "include"
PROGRAM = r"""
#include "blocks.h"
int main(int argc, char **argv) {
  sfb_writer w;
  sfb_block b;
  sfb_reading r;
  sfb_platform p;
  char line[64];
  int err = sfb_start_writing(&w, argv[1], sfb_platform_schema(), 0640, 200);
  (void)argc;
  printf("start %d\n", err);
  fflush(stdout);
  if (err != 0) return 1;
  memset(&p, 0, sizeof p);
  while (fgets(line, sizeof line, stdin) != NULL) {
    if (line[0] == 'w') { /* publish */
      p.t_ns++;
      p.pose[1] = 0.5 * (double)p.t_ns;
      if (p.state[0] == 0) strcpy(p.state, "from C");
      printf("wrote %lld\n", (long long)sfb_write(&w, &p, 2000));
    } else if (line[0] == 'r') { /* read it back, waiting */
      err = sfb_open(&b, argv[1], SFB_PLATFORM_HASH, sizeof p);
      if (err == 0) {
        const int64_t g = sfb_read_begin(&b, argv[1], &r, 200);
        const sfb_platform *seen = g > 0 ? (const sfb_platform *)(const void *)r.payload : &p;
        printf("read %lld %g\n", (long long)g, g > 0 ? seen->pose[1] : -1.0);
        if (g > 0 && sfb_read_done(&b, &r) != 0) return 3;
        sfb_close(&b);
      }
    } else if (line[0] == 't') { /* the text that follows, cut to its member */
      const size_t n = strlen(line) - 2;
      char text[sizeof p.state + 1];
      memcpy(p.state, line + 1, n < sizeof p.state ? n : sizeof p.state);
      printf("text %lu %s\n", (unsigned long)sfb_text(text, p.state, sizeof p.state), text);
    } else if (line[0] == 'e') {
      break;
    }
    fflush(stdout);
  }
  sfb_end_writing(&w, 0);
  return 0;
}
"""


@pytest.fixture(scope="module", params=["c11", "c++17"])
def program(request, tmp_path_factory):
    if shutil.which("cc") is None or shutil.which("c++") is None:
        pytest.skip("no C compiler")
    folder = tmp_path_factory.mktemp("writer")
    (folder / "blocks.h").write_text(c_header([Platform]))
    source = folder / "writer.c"
    source.write_text(PROGRAM)
    compiler = ["cc"] if request.param == "c11" else ["c++", "-x", "c++"]
    flags = ["-g", "-O1", f"-std={request.param}", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wshadow"]
    flags += ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", f"-I{INCLUDE}"]
    done = subprocess.run(
        [*compiler, *flags, str(source), "-o", str(folder / "writer")], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return folder / "writer"


class Writer:
    """The program, driven by one letter at a time."""

    def __init__(self, program, name):
        pipe = subprocess.PIPE
        self.process = subprocess.Popen([str(program), name], stdin=pipe, stdout=pipe, text=True, bufsize=1)
        self.started = self.process.stdout.readline().strip()

    def __call__(self, letter):
        self.process.stdin.write(letter + "\n")
        return self.process.stdout.readline().strip()

    def end(self):
        self.process.communicate("e\n", timeout=60)
        return self.process.returncode

    def kill(self):
        self.process.send_signal(signal.SIGKILL)
        self.process.communicate()


@pytest.fixture
def writer(program, space):
    made = []

    def start():
        made.append(Writer(program, f"{space}.platform"))
        return made[-1]

    yield start
    for one in made:
        one.kill()


def test_python_reads_what_c_publishes_and_may_not_write_meanwhile(space, writer):
    one = writer()
    assert one.started == "start 0"
    assert one("w") == "wrote 1"
    assert one("w") == "wrote 2"
    assert one("r") == "read 2 1"
    with mem_attach(Platform, space) as mem:
        values = mem.platform.latest()
        assert (values["t_ns"], values["pose"], values["state"]) == (2, (0.0, 1.0, 0.0), "from C")
        assert values.generation == 2
        with pytest.raises(BusyError, match=str(one.process.pid)):
            mem_attach(Platform, space, write=True)
        assert one.end() == 0
        assert mem.platform.latest().stale
    assert not list(Path("/dev/shm").glob(f"{space}*"))


def test_a_text_that_fills_its_member_is_read_whole(space, writer):
    one = writer()
    assert one("tshort") == "text 5 short"
    # GIVEN a text as long as its member, without a NUL, and one that is longer
    assert one("t0123456789abcdef") == "text 16 0123456789abcdef"
    assert one("t0123456789abcdefgh") == "text 16 0123456789abcdef"
    # WHEN it is published, THEN Python reads the whole
    assert one("w") == "wrote 1"
    with mem_attach(Platform, space) as mem:
        assert mem.platform.latest()["state"] == "0123456789abcdef"
    assert one.end() == 0


def test_the_generated_header_says_that_texts_have_no_terminating_nul():
    (member,) = [line for line in c_header(Platform).splitlines() if "char state[16];" in line]
    assert "without a NUL where it fills the array: sfb_text" in member


def test_the_page_of_the_c_interface_lists_every_function_of_a_blocks_header():
    page = (Path(__file__).parents[2] / "docs/reference/c-api.md").read_text(encoding="utf-8")
    text = re.sub(r"\w+_schema\(void\)", "", c_header(Platform))
    names = set(re.findall(r"^static inline [^;{(]*?\b(sfb_(?!i_|word)\w+)\(", text, re.MULTILINE))
    assert names == set(re.findall(r"^### (sfb_\w+)$", page, re.MULTILINE))


def test_c_and_python_take_over_from_each_other_after_a_death(space, writer):
    one = writer()
    one("w")
    one.kill()
    with mem_attach(Platform, space, write=True) as mem:
        assert mem.platform.latest()["t_ns"] == 1
        with mem.platform.write() as slot:
            slot.t_ns = 41
        epoch = mem.platform.epoch
        assert writer().started == "start -16"
        mem.platform.close(keep=True)
    two = writer()
    assert two.started == "start 0"
    assert two("r") == "read 2 0.5"
    assert two("w") == "wrote 3"
    with mem_attach(Platform, space) as mem:
        assert mem.platform.epoch == epoch + 1


def test_a_reader_holds_the_writer_in_c_up_for_its_lease_at_most(space, writer):
    one = writer()
    one("w")
    with mem_attach(Platform, space) as mem:
        view, generation = mem.platform.get_read_ok()
        start = time.monotonic()
        assert one("w") == "wrote 2"
        assert time.monotonic() - start >= 0.2
        assert generation == 1
        assert view.t_ns == 1
        assert mem.platform.read_done() == "stale"


def test_a_block_of_another_schema_is_given_up_and_made_anew(space, writer):
    class Other(Block):
        """Something else under the name."""

        word = I64(3)

    with mem_attach({"platform": Other}, space, write=True) as mem:
        with mem.platform.write() as slot:
            slot.word = (1, 2, 3)
        reader = mem_attach({"platform": Other}, space).platform
        mem.platform.close(keep=True)
    assert writer().started == "start 0"
    assert reader.latest().stale
    with mem_attach(Platform, space) as again:
        assert again.platform.latest().generation == 0
