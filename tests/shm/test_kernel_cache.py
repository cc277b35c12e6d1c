"""The kernel cache between processes that write at once, die while they do, or run another source."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import pytest

from surffollow.shm import cache_directory as cache_module
from surffollow.shm import kernel_cache
from surffollow.shm.kernel_cache import KernelCacheFile

STAMP = "a" * 32


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(kernel_cache, "cache_directory", lambda: str(tmp_path))
    inside = tmp_path / "shm"
    inside.mkdir()
    return inside


def cache_file(folder: Path, stamp: str = STAMP) -> KernelCacheFile:
    return KernelCacheFile(str(folder), "ring.push-31.py311", stamp)


def test_numba_keeps_its_files_through_this_one() -> None:
    from surffollow.shm.ring import ring_length

    assert isinstance(ring_length._cache._cache_file, KernelCacheFile)


def test_what_was_kept_is_found_again_and_another_signature_is_not(folder: Path) -> None:
    cache_file(folder).save("int64", b"code")
    assert cache_file(folder).load("int64") == b"code"
    assert cache_file(folder).load("float64") is None


def test_processes_that_save_at_once_lose_and_exchange_nothing(folder: Path) -> None:
    keys = [f"signature {n}" for n in range(8)]
    children = []
    for mine in keys:
        pid = os.fork()
        if pid == 0:
            for key in [mine, *keys]:
                cache_file(folder).save(key, key.encode())
            os._exit(0)
        children.append(pid)
    assert [os.waitpid(pid, 0)[1] for pid in children] == [0] * len(keys)
    assert [cache_file(folder).load(key) for key in keys] == [key.encode() for key in keys]


@pytest.mark.parametrize("step", ["_save_data", "_save_index"])
def test_a_process_killed_between_its_two_writes_leaves_no_wrong_code(
    folder: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    cache_file(folder).save("old", b"old code")
    pid = os.fork()
    if pid == 0:
        monkeypatch.setattr(KernelCacheFile, step, lambda *_: os._exit(9))
        cache_file(folder).save("new", b"new code")
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 9
    assert cache_file(folder).load("new") is None
    cache_file(folder).save("other", b"other code")
    found = [cache_file(folder).load(key) for key in ("old", "new", "other")]
    assert found == [b"old code", None, b"other code"]


def test_another_source_never_finds_old_code_and_sweeps_it_away(folder: Path) -> None:
    cache_file(folder).save("int64", b"yesterday")
    (folder / "ring.push-31.py311.nbi.tmp.0123").write_bytes(b"of a killed process")
    changed = cache_file(folder, "b" * 32)
    assert changed.load("int64") is None
    changed.save("float64", b"today")
    assert changed.load("int64") is None
    assert cache_file(folder).load("int64") is None
    assert len([f for f in os.listdir(folder) if f.startswith("ring.push")]) == 2, "index and one data file"


@pytest.mark.parametrize("which", ["*.nbi", "*.nbc"])
@pytest.mark.parametrize("rest", [0, 7])
def test_a_file_cut_by_a_power_failure_is_as_good_as_none_and_is_written_again(
    folder: Path, which: str, rest: int
) -> None:
    cache_file(folder).save("int64", b"code")
    (cut,) = folder.glob(which)
    cut.write_bytes(cut.read_bytes()[:rest])
    assert cache_file(folder).load("int64") is None
    cache_file(folder).save("int64", b"code")
    assert cache_file(folder).load("int64") == b"code"


def test_a_folder_that_went_away_or_a_full_disk_costs_the_entry_only(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(KernelCacheFile, "_save_data", full)
        cache_file(folder).save("int64", b"code")
    assert cache_file(folder).load("int64") is None
    gone = cache_file(folder / "gone")
    gone.save("int64", b"code")
    assert gone.load("int64") is None


def test_the_cache_of_others_stays_as_numba_keeps_it(folder: Path, tmp_path_factory) -> None:
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    theirs = KernelCacheFile(str(elsewhere), "f-1.py311", 12.5)
    theirs.save("int64", b"code")
    assert sorted(f.name for f in elsewhere.iterdir()) == ["f-1.py311.1.nbc", "f-1.py311.nbi"]
    assert pickle.loads((elsewhere / "f-1.py311.1.nbc").read_bytes()) == b"code"


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
