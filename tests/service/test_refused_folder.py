"""A /dev/shm that takes no files: the reason and the remedy."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable

import pytest

from running_service import WAIT_S, Service
from second_user import AS_NOBODY, NOBODY
from surffollow.shm.refused_files import amount

Make = Callable[..., Service]
pytestmark = pytest.mark.skipif(
    os.geteuid() != 0 or shutil.which("unshare") is None,
    reason="needs root and unshare for a /dev/shm of its own",
)


def start_in(service: Service, options: str, *before: str) -> str:
    """Start in a /dev/shm that is mounted with these options; the one line of the refusal."""
    script = f'mount -t tmpfs -o {options} tmpfs /dev/shm && exec "$@"'
    # another user cannot read the test's configuration
    start = service.command("start", "--quiet") if before else service.start_command()
    words = ["unshare", "-m", "sh", "-c", script, "x", *before, *start]
    done = subprocess.run(words, capture_output=True, text=True, timeout=WAIT_S)
    assert done.returncode != 0
    *_, line = done.stderr.strip().splitlines()  # another user may have no folder for compiled kernels
    assert service.name in line
    return line


def test_a_folder_of_root_alone_is_named_with_its_mode(make_service: Make) -> None:
    line = start_in(make_service(), "mode=755", *AS_NOBODY)
    assert f"user {NOBODY} may make no files in /dev/shm (mode 755, of user 0)" in line
    assert "chmod 1777 /dev/shm" in line
    assert "user -1" not in line


def test_a_read_only_mount_is_named(make_service: Make) -> None:
    line = start_in(make_service(), "ro")
    assert "/dev/shm is mounted read-only" in line
    assert "mount -o remount,rw /dev/shm" in line


@pytest.mark.parametrize("files", [1, 2, 3, 4])
def test_a_lack_of_files_is_named_with_the_remedy(make_service: Make, files: int) -> None:
    """One is the folder itself; then lock, map and board take one each, and the socket."""
    line = start_in(make_service(grids=1000), f"size=64m,nr_inodes={files}")
    assert f"/dev/shm has its {files} files (df -i /dev/shm)" in line
    assert "remount,nr_inodes=" in line


def test_little_room_is_shown_in_kib(make_service: Make) -> None:
    line = start_in(make_service(), "size=16k")
    assert "has 16 KiB free" in line or "has 12 KiB free" in line


def test_only_nothing_reads_as_nothing() -> None:
    assert [amount(n) for n in (0, 1, 4096, 104_858, 5 << 20)] == [
        "0 KiB",
        "1 KiB",
        "4 KiB",
        "0.1 MiB",
        "5.0 MiB",
    ]
