"""The kernel cache between processes that write at once, die while they do, or run another source."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from surffollow.shm import cache_directory as cache_module
from surffollow.shm import kernel_cache
from surffollow.shm.kernel_cache import KernelCache

STAMP = "a" * 32


def cache(folder: Path, stamp: str = STAMP) -> KernelCache:
    return KernelCache(folder, "ring.push.py311", stamp)


def test_what_was_kept_is_found_again_and_another_signature_is_not(tmp_path: Path) -> None:
    cache(tmp_path).save("part", "int64", b"code")
    assert cache(tmp_path).load("part", "int64") == b"code"
    assert cache(tmp_path).load("part", "float64") is None
    assert cache(tmp_path).load("whole", "int64") is None


def test_processes_that_save_at_once_lose_and_exchange_nothing(tmp_path: Path) -> None:
    keys = [f"signature {n}" for n in range(8)]
    children = []
    for mine in keys:
        pid = os.fork()
        if pid == 0:
            for key in [mine, *keys]:
                cache(tmp_path).save("part", key, key.encode())
            os._exit(0)
        children.append(pid)
    assert [os.waitpid(pid, 0)[1] for pid in children] == [0] * len(keys)
    assert [cache(tmp_path).load("part", key) for key in keys] == [key.encode() for key in keys]


def test_a_process_killed_while_it_writes_leaves_no_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pid = os.fork()
    if pid == 0:
        monkeypatch.setattr(kernel_cache.os, "replace", lambda *_: os._exit(9))
        cache(tmp_path).save("part", "new", b"new code")
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 9
    assert cache(tmp_path).load("part", "new") is None


def test_another_source_never_finds_old_code_and_sweeps_it_away(tmp_path: Path) -> None:
    cache(tmp_path).save("part", "int64", b"yesterday")
    (tmp_path / "ring.push.py311.0123.of-a-killed-process.tmp").write_bytes(b"x")
    (tmp_path / "ring.push_all.py311.0123.part-0.nbc").write_bytes(b"of another kernel")
    changed = cache(tmp_path, "b" * 32)
    assert changed.load("part", "int64") is None
    changed.save("part", "float64", b"today")
    assert cache(tmp_path).load("part", "int64") is None
    assert len([f for f in os.listdir(tmp_path) if f.startswith("ring.push.")]) == 1
    assert len(os.listdir(tmp_path)) == 2


@pytest.mark.parametrize("rest", [0, 7, 40])
def test_a_file_cut_by_a_power_failure_is_as_good_as_none_and_is_written_again(
    tmp_path: Path, rest: int
) -> None:
    cache(tmp_path).save("part", "int64", b"code")
    (cut,) = tmp_path.glob("*.nbc")
    cut.write_bytes(cut.read_bytes()[:rest])
    assert cache(tmp_path).load("part", "int64") is None
    cache(tmp_path).save("part", "int64", b"code")
    assert cache(tmp_path).load("part", "int64") == b"code"


def test_every_damaged_byte_is_noticed(tmp_path: Path) -> None:
    cache(tmp_path).save("part", "int64", b"code")
    (file,) = tmp_path.glob("*.nbc")
    good = file.read_bytes()
    for at in range(len(good)):
        file.write_bytes(good[:at] + bytes([good[at] ^ 1]) + good[at + 1 :])
        assert cache(tmp_path).load("part", "int64") is None


def test_a_file_under_another_signatures_name_is_not_used(tmp_path: Path) -> None:
    cache(tmp_path).save("part", "int64", b"code of int64")
    (one,) = tmp_path.glob("*.nbc")
    cache(tmp_path).save("part", "float64", b"code of float64")
    (other,) = set(tmp_path.glob("*.nbc")) - {one}
    os.replace(other, one)
    assert cache(tmp_path).load("part", "int64") is None


@pytest.mark.parametrize("option", kernel_cache.OPTIONS)
def test_an_option_of_the_environment_tells_files_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str
) -> None:
    cache(tmp_path).save("part", "int64", b"code")
    monkeypatch.setattr(kernel_cache.config, option, 99)
    assert cache(tmp_path).load("part", "int64") is None


def test_another_version_of_numpy_compiles_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache(tmp_path).save("part", "int64", b"code")
    monkeypatch.setattr(kernel_cache, "_VERSIONS", ("0", "0", "0", "0"))
    assert cache(tmp_path).load("part", "int64") is None
    cache(tmp_path).save("part", "int64", b"new code")
    assert len(os.listdir(tmp_path)) == 1, "what an older version compiled is deleted"


def test_a_folder_that_cannot_be_made_or_a_full_disk_costs_the_entry_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(kernel_cache, "cache_directory", lambda: str(tmp_path))
    with monkeypatch.context() as patch:
        patch.setattr(kernel_cache.os, "replace", full)
        cache(tmp_path).save("part", "int64", b"code")
        cache(tmp_path).save("part", "float64", b"code")
    said = capsys.readouterr().err
    assert f"cannot be kept in {tmp_path} (No space left on device)" in said
    assert said.count("\n") == 1, "said once"
    assert cache(tmp_path).load("part", "int64") is None
    assert os.listdir(tmp_path) == []
    (tmp_path / "file").touch()
    lost = cache(tmp_path / "file" / "below")
    lost.save("part", "int64", b"code")
    assert lost.load("part", "int64") is None


def test_without_any_writable_place_a_temporary_folder_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("SURFFOLLOW_CACHE_DIR", "NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.setenv(name, "/proc/none")
    monkeypatch.setattr(cache_module.os, "access", lambda *_: False)
    found = Path(cache_module.cache_directory.__wrapped__())
    try:
        assert found.is_dir()
        assert found.name == "surffollow"
        assert "surffollow-cache-" in str(found)
    finally:
        found.rmdir()
        found.parent.rmdir()
