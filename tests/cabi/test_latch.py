"""The C latch beside the Python one, the cost of its calls, and what a thread sanitizer says."""

from __future__ import annotations

import mmap
import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cabi.latch_threads import AARCH64, THREADS
from cabi.running import numbers, run
from running_service import Service
from surffollow.shm.latch import latch_read, latch_write
from surffollow.shm.latch_shape import latch_bytes

TWIN = """
#include "surffollow.h"
int main(int argc, char **argv) {
  const int64_t words = argc > 2 ? strtol(argv[2], NULL, 10) : 0;
  int fd = open(argv[1], O_RDWR);
  unsigned char *memory = (unsigned char *)mmap(NULL, 65536, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
  int64_t payload[64], from = 1;
  const size_t bytes = (size_t)words * 8;
  int64_t g = sf_latch_read(memory, bytes, payload);
  if (g > 0)
    for (int64_t k = 0; k < words; k++) printf("%" PRId64 " ", payload[k]);
  if (g > 0 && words > 2) g = sf_latch_read_part(memory, bytes, 16, 1, &from);
  printf("| %" PRId64 " %" PRId64 "\\n", g, from);
  for (int64_t k = 0; k < words; k++) payload[k] = 1000 + k;
  sf_latch_write(memory, bytes, payload);
  return 0;
}
"""


@pytest.mark.parametrize("words", [1, 2, 8, 9, 63])
def test_c_and_python_latches_are_one(
    compile_program: Callable[..., Path], tmp_path: Path, words: int
) -> None:
    program, path = compile_program(TWIN), tmp_path / "latch"
    path.write_bytes(bytes(65536))
    assert latch_bytes(8 * words) <= 65536
    assert run(program, str(path), str(words)).split() == ["|", "0", "1"]  # nothing published yet
    with path.open("r+b") as f, mmap.mmap(f.fileno(), 65536) as memory:
        whole = np.frombuffer(memory, np.uint8)
        address, got = whole.ctypes.data, np.zeros(words, np.int64)
        assert latch_read(address, got.ctypes.data, 8 * words) == 1  # written by C
        assert got.tolist() == [1000 + k for k in range(words)]
        for generation in range(2, 8):
            sent = np.arange(words) * 7 + generation
            latch_write(address, sent.ctypes.data, 8 * words)
        head, _, tail = run(program, str(path), str(words)).partition("|")
        assert [int(w) for w in head.split()] == sent.tolist()
        assert [int(w) for w in tail.split()] == [7, sent[2] if words > 2 else 1]
        del whole


def test_reader_gives_up_after_bounded_tries(compile_program: Callable[..., Path]) -> None:
    source = """
    #include "surffollow.h"
    int main(void) {
      static _Alignas(64) int64_t latch[8 + 4 * 8], out[8];
      latch[0] = 4;
      int64_t g = sf_latch_read(latch, 64, out);
      latch[0] = -4; /* damaged: still inside its own slots */
      printf("ok %d damaged %d\\n", g == 4, sf_latch_read(latch, 64, out) == -4);
      return 0;
    }
    """
    assert numbers(run(compile_program(source, "-fsanitize=address,undefined"))) == {"ok": 1, "damaged": 1}


HOT = """
#include "surffollow.h"
void *__real_malloc(size_t n);
void *__wrap_malloc(size_t n);
void *__real_calloc(size_t n, size_t m);
void *__wrap_calloc(size_t n, size_t m);
static long calls;
void *__wrap_malloc(size_t n) { calls++; return __real_malloc(n); }
void *__wrap_calloc(size_t n, size_t m) { calls++; return __real_calloc(n, m); }
int main(int argc, char **argv) {
  sf_client c;
  const double pose[7] = {0.05, 0.05, 0.1, 0, 0, 0, 1};
  sf_options patient = sf_default_options();
  patient.stale_min_ns = 60000000000; /* a busy machine may keep the service silent for a moment */
  if (argc < 2 || sf_attach_with(&c, argv[1], &patient) != SF_OK || sf_claim_pose(&c) != SF_OK) return 1;
  sf_demand d;
  double range;
  for (int k = 0; k <= 100; k++) {
    if (k == 1) getppid(); /* for who counts what the hundred rounds after the first ask of the kernel */
    if (sf_ee_pos(&c, pose, SF_NOW) != SF_OK) return 2;
    sf_dev_vector(&c, &d);
    sf_raw_distance(&c, 0, &range);
    sf_map_height(&c, 0.05, 0.05, &range);
  }
  getppid();
  printf("calls %ld n 1\\n", calls);
  sf_detach(&c);
  return 0;
}
"""


def test_no_call_allocates(compile_program: Callable[..., Path], service: Service) -> None:
    program = compile_program(HOT, "-O2", "-Wl,--wrap=malloc", "-Wl,--wrap=calloc")
    assert numbers(run(program, service.name))["calls"] == 0


def test_hot_calls_make_no_system_call(compile_program: Callable[..., Path], service: Service) -> None:
    """The clock is read in user space; everything else is loads and stores."""
    if subprocess.run(["which", "strace"], capture_output=True).returncode:
        pytest.skip("no strace on this machine")
    program = compile_program(HOT, "-O2", "-Wl,--wrap=malloc", "-Wl,--wrap=calloc")
    traced = subprocess.run(["strace", "-f", str(program), service.name], capture_output=True, text=True)
    assert traced.returncode == 0, traced.stderr
    _, hot, _ = traced.stderr.split("getppid()")
    assert len(hot.splitlines()) < 50, hot  # 400 calls of ours, a look at the service ten times a second


def test_thread_sanitizer_finds_no_race_between_writer_and_readers(
    compile_program: Callable[..., Path],
) -> None:
    # this sanitizer does not model fences; the loads and stores they order are atomic all the same
    program = compile_program(THREADS, "-O1", "-g", "-fsanitize=thread", "-Wno-tsan", "-pthread")
    done = subprocess.run([str(program)], capture_output=True, text=True, timeout=60)
    if "unexpected memory mapping" in done.stderr:
        pytest.skip("this kernel's address space layout does not suit the thread sanitizer")
    assert done.returncode == 0, done.stderr
    found = numbers(done.stdout)
    assert found["torn"] == 0
    assert found["reads"] > 100


def test_size_of_a_client_is_small_enough_for_any_stack(compile_program: Callable[..., Path]) -> None:
    source = (
        '#include "surffollow.h"\nint main(void) { printf("bytes %zu\\n", sizeof(sf_client)); return 0; }\n'
    )
    assert numbers(run(compile_program(source)))["bytes"] < 1024


def test_latch_on_aarch64_orders_its_loads_and_stores_by_instructions(tmp_path: Path) -> None:
    if subprocess.run(["which", AARCH64], capture_output=True).returncode:
        pytest.skip(f"no {AARCH64} on this machine")
    source = tmp_path / "a.c"
    source.write_text("""
    #include "surffollow.h"
    int64_t reading(const void *latch, void *out);
    void writing(void *latch, const void *in);
    int64_t reading(const void *latch, void *out) { return sf_latch_read(latch, 64, out); }
    void writing(void *latch, const void *in) { sf_latch_write(latch, 64, in); }
    """)
    include = f"-I{Path(__file__).parents[2] / 'include'}"
    command = [AARCH64, "-std=c11", "-O2", "-S", include, str(source), "-o", "-"]
    text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    reading, writing = text[text.index("reading:") :], text[text.index("writing:") :]
    assert "ldar" in reading or "ldapr" in reading  # R1
    assert "dmb\tishld" in reading  # R3
    assert "dmb\tish\n" in writing  # W1
    assert "stlr" in writing  # W3


def test_latch_on_x86_needs_no_fence_instruction(tmp_path: Path) -> None:
    if os.uname().machine != "x86_64":
        pytest.skip("this is no x86-64")
    source = tmp_path / "a.c"
    source.write_text("""
    #include "surffollow.h"
    int64_t reading(const void *latch, void *out);
    int64_t reading(const void *latch, void *out) { return sf_latch_read(latch, 64, out); }
    """)
    include = f"-I{Path(__file__).parents[2] / 'include'}"
    text = subprocess.run(
        ["gcc", "-std=c11", "-O2", "-S", include, str(source), "-o", "-"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert not any(word in text for word in ("mfence", "lfence", "lock", "xchg"))
