"""Shared-memory objects: names, space, rights, locks and what is left behind."""

from __future__ import annotations

import os
import stat
from types import SimpleNamespace

import pytest

from second_user import NOBODY
from surffollow.config.names import check_name
from surffollow.errors import (
    BlockError,
    InvalidNameError,
    NoPermissionError,
    NoSpaceError,
    NotRunningError,
)
from surffollow.shm.objects import SHM_ROOT, SharedObject, unlink
from surffollow.shm.process import boot_id, start_ticks


@pytest.fixture
def name():
    n = f"test-objects-{os.getpid()}"
    yield n
    unlink(n)


def in_child(act, uid=None):
    """Run `act` in a forked child; its return value (0 to 100), or 101 when it raised."""
    pid = os.fork()
    if pid == 0:
        code = 101
        try:
            if uid is not None:
                os.setgroups([])
                os.setgid(uid)
                os.setuid(uid)
            code = int(act())
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


@pytest.mark.parametrize(
    "bad",
    [
        "",
        "/surf",
        "a/b",
        "../x",
        ".",
        "..",
        ".hidden",
        "-x",
        "a b",
        "a\0",
        "a\n",
        "ä",
        "x" * 65,
        None,
        7,
        b"x",
    ],
)
def test_names_that_a_path_could_misread_are_refused(bad):
    with pytest.raises(InvalidNameError, match="not allowed"):
        check_name(bad)
    with pytest.raises(InvalidNameError):
        SharedObject.open(bad)
    with pytest.raises(InvalidNameError):
        SharedObject.create(bad, 4096, 0o600)


@pytest.mark.parametrize("good", ["surf", "a", "A.b_c-9", "0", "x" * 48])
def test_plain_names_are_allowed(good):
    assert check_name(good) == good


def test_a_new_object_is_zero_of_the_asked_size_and_shared(name):
    made = SharedObject.create(name, 3 * 4096, 0o600)
    assert made.size == 3 * 4096
    assert bytes(made.memory) == bytes(3 * 4096)
    seen = SharedObject.open(name)
    made.memory[5] = 42
    assert seen.memory[5] == 42
    assert (SHM_ROOT / name).stat().st_blocks * 512 >= 3 * 4096, "pages are not reserved"
    seen.close()
    made.close()


def test_reading_gives_no_way_to_write(name):
    SharedObject.create(name, 4096, 0o600).close()
    seen = SharedObject.open(name)
    with pytest.raises(TypeError):
        seen.memory[0] = 1
    seen.close()


def test_an_existing_object_is_never_taken_over(name):
    SharedObject.create(name, 4096, 0o600).close()
    with pytest.raises(BlockError, match="exists"):
        SharedObject.create(name, 4096, 0o600)


def test_a_missing_object_is_named_with_a_remedy(name):
    with pytest.raises(NotRunningError, match=f"no shared-memory object {name!r}; start the program"):
        SharedObject.open(name)
    assert unlink(name) is False


def test_an_empty_object_is_not_mapped(name):
    (SHM_ROOT / name).touch(mode=0o600)
    with pytest.raises(BlockError, match="being made"):
        SharedObject.open(name)


def test_nothing_is_followed_through_a_link(name, tmp_path):
    target = tmp_path / "secret"
    target.write_bytes(b"x" * 4096)
    link = SHM_ROOT / name
    link.symlink_to(target)
    try:
        with pytest.raises(BlockError):
            SharedObject.create(name, 4096, 0o600)
        with pytest.raises(BlockError):
            SharedObject.open(name, writable=True)
    finally:
        link.unlink(missing_ok=True)
    assert target.read_bytes() == b"x" * 4096


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o660, 0o666])
def test_the_mode_is_what_was_asked_whatever_the_umask(name, mode):
    old = os.umask(0o077)
    try:
        SharedObject.create(name, 4096, mode).close()
    finally:
        os.umask(old)
    assert stat.S_IMODE((SHM_ROOT / name).stat().st_mode) == mode


def test_too_large_an_object_is_refused_before_anything_is_made(name, monkeypatch):
    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_bavail=1, f_frsize=4096))
    with pytest.raises(NoSpaceError, match="needs 8 KiB and /dev/shm has 4 KiB free"):
        SharedObject.create(name, 8192, 0o600)
    assert not (SHM_ROOT / name).exists()


def test_a_file_system_that_fills_up_meanwhile_leaves_nothing_behind(name, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(NoSpaceError, match="remount"):
        SharedObject.create(name, 8192, 0o600)
    assert not (SHM_ROOT / name).exists()


@pytest.mark.parametrize(
    ("part", "advice"),
    [
        ("", "fewer log_words"),
        (".map", r"fewer map\.grids"),
        (".world", "unused objects"),
        (".poses", "a block"),
    ],
)
def test_the_advice_for_too_little_room_fits_the_object(name, monkeypatch, part, advice):
    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_bavail=1, f_frsize=4096))
    with pytest.raises(NoSpaceError, match=f"remount.* or .*{advice}"):
        SharedObject.create(name.replace(".", "-") + part, 8192, 0o600)


def test_a_group_that_may_not_be_given_leaves_nothing_behind(name, monkeypatch):
    def refused(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "fchown", refused)
    with pytest.raises(NoPermissionError, match="group 12"):
        SharedObject.create(name, 4096, 0o660, group=12)
    assert not (SHM_ROOT / name).exists()


@pytest.mark.skipif(os.getuid() != 0, reason="only root can act as another user")
def test_other_users_are_refused_by_the_mode_with_a_remedy(name):
    made = SharedObject.create(name, 4096, 0o640)

    def try_to(writable):
        try:
            SharedObject.open(name, writable=writable)
        except NoPermissionError as e:
            return 1 if "join its group" in str(e) else 2
        return 0

    assert in_child(lambda: try_to(False), NOBODY) == 1
    assert in_child(lambda: try_to(True), NOBODY) == 1
    os.fchmod(made.fd, 0o644)
    assert in_child(lambda: try_to(False), NOBODY) == 0
    assert in_child(lambda: try_to(True), NOBODY) == 1

    def remove():
        try:
            unlink(name)
        except NoPermissionError:
            return 1
        return 0

    assert in_child(remove, NOBODY) == 1
    made.close()


def test_an_object_knows_when_its_name_leads_elsewhere(name):
    old = SharedObject.create(name, 4096, 0o600)
    assert old.is_current()
    assert unlink(name) is True
    assert not old.is_current()
    new = SharedObject.create(name, 4096, 0o600)
    assert new.is_current()
    assert not old.is_current()
    old.memory[0] = 7  # mapped memory stays usable
    assert new.memory[0] == 0
    old.close()
    new.close()


def test_closing_twice_and_while_views_are_held_is_harmless(name):
    made = SharedObject.create(name, 4096, 0o600)
    view = memoryview(made.memory)
    made.close()
    made.close()
    assert view[0] == 0


def test_processes_are_distinguished_by_start_time_and_boots_by_identity():
    assert start_ticks(os.getpid()) > 0
    assert start_ticks(2**22 + 1) == 0
    assert len(boot_id()) == 36
