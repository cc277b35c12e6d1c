"""A kernel cache holds code that is run: no folder that another user could change is used."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from second_user import NOBODY, needs_root
from surffollow.errors import ConfigError
from surffollow.shm import cache_directory as cache_module
from surffollow.shm import kernel_cache
from surffollow.shm.trusted_folder import why_not_trusted

VARIABLES = ("SURFFOLLOW_CACHE_DIR", "NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME")


@pytest.fixture
def only(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A folder named by SURFFOLLOW_CACHE_DIR, the one place there is; temporary folders lie beside it."""
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    tmp_path.chmod(0o755)
    (tmp_path / "tmp").mkdir(mode=0o700)
    monkeypatch.setattr(cache_module.tempfile, "tempdir", str(tmp_path / "tmp"))
    cache = tmp_path / "above" / "cache"
    monkeypatch.setenv("SURFFOLLOW_CACHE_DIR", str(cache))
    return cache


def taken() -> Path:
    return Path(cache_module.cache_directory.__wrapped__())


def test_a_folder_of_ones_own_is_made_private_and_kept(
    only: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert taken() == only / "surffollow"
    for folder in (only, only / "surffollow", only.parent):
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert taken() == only / "surffollow"
    assert capsys.readouterr().err == ""


def test_a_folder_that_cannot_be_written_is_named_with_a_remedy_that_is_not_there_yet(
    only: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    only.parent.mkdir()
    only.write_text("")  # a plain file stands there
    taken()
    said = capsys.readouterr().err
    assert f"{only}/surffollow cannot be made" in said
    assert "let SURFFOLLOW_CACHE_DIR name a folder that this user can write" in said
    monkeypatch.delenv("SURFFOLLOW_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(only))
    taken()
    assert "name a folder of your own: SURFFOLLOW_CACHE_DIR" in capsys.readouterr().err


@needs_root
@pytest.mark.parametrize("which", ["surffollow", ".", ".."])
def test_a_cache_folder_that_somebody_else_made_is_passed_over(
    only: Path, capsys: pytest.CaptureFixture[str], which: str
) -> None:
    theirs = only / "surffollow"
    theirs.mkdir(parents=True, mode=0o755)
    os.chown(theirs / "." if which == "surffollow" else theirs / ".." / which, NOBODY, NOBODY)
    found = taken()
    assert only not in found.parents
    assert found.stat().st_uid == os.geteuid()
    assert stat.S_IMODE(found.stat().st_mode) == 0o700
    said = capsys.readouterr().err
    assert f"belongs to user {NOBODY}" in said
    assert str(found) in said
    assert len(said.splitlines()) == 1


@pytest.mark.parametrize(("above", "mode"), [(False, 0o770), (False, 0o707), (True, 0o775), (True, 0o757)])
def test_a_component_that_others_can_write_is_named(
    only: Path, capsys: pytest.CaptureFixture[str], above: bool, mode: int
) -> None:
    (only / "surffollow").mkdir(parents=True)
    open_one = only.parent if above else only / "surffollow"
    open_one.chmod(mode)
    assert only not in taken().parents
    assert f"{open_one} can be written by others (mode {mode:o})" in capsys.readouterr().err


@needs_root
def test_a_link_of_somebody_else_is_not_followed(only: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    (mine / "surffollow").mkdir(parents=True, mode=0o755)
    only.parent.mkdir(mode=0o755)
    only.symlink_to(mine)
    assert taken().resolve() == mine / "surffollow", "a link of one's own is"
    os.lchown(only, NOBODY, NOBODY)
    assert "is a link of user" in why_not_trusted(only / "surffollow")
    assert mine not in taken().parents


def test_a_sticky_folder_is_no_danger_above_and_links_in_a_ring_end(tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    sticky = tmp_path / "sticky"
    sticky.mkdir()
    sticky.chmod(0o1777)
    (sticky / "mine").mkdir(mode=0o700)
    assert why_not_trusted(sticky / "mine") == ""
    assert "can be written" in why_not_trusted(sticky), "but to keep things in it is"
    (tmp_path / "ring").symlink_to("ring")
    assert why_not_trusted(tmp_path / "ring" / "x") != ""
    (tmp_path / "there").symlink_to("sticky/../sticky")
    assert why_not_trusted(tmp_path / "there" / "mine") == ""
    assert why_not_trusted(tmp_path / "nowhere") != ""


def test_the_fresh_folder_goes_with_its_process(only: Path) -> None:
    only.mkdir(parents=True)
    only.chmod(0o777)
    code = "from surffollow.shm.cache_directory import cache_directory as c; print(c())"
    env = {k: v for k, v in os.environ.items() if k not in VARIABLES} | {
        "SURFFOLLOW_CACHE_DIR": str(only),
        "TMPDIR": str(only),  # not to be trusted either: nothing in a folder without a sticky bit stays ours
    }
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "can be written by others" in done.stderr
    assert not Path(done.stdout.strip()).exists()


@pytest.mark.parametrize("mode", [0o777, 0o775])
def test_the_fresh_folder_is_not_made_where_others_can_rename_it(
    only: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, mode: int
) -> None:
    temporary, safe = tmp_path / "tmp", tmp_path / "safe"
    for folder in (temporary, only):
        folder.mkdir(parents=True, exist_ok=True)
        folder.chmod(mode)
    safe.mkdir(mode=0o700)
    monkeypatch.setattr(cache_module, "FRESH_IN", (str(safe),))
    found = taken()
    assert safe in found.parents
    assert why_not_trusted(found) == ""
    assert [p.name for p in temporary.iterdir()] == [f"surffollow-cache-{os.getuid()}"], "nothing fresh"
    monkeypatch.setattr(cache_module, "FRESH_IN", ())
    with pytest.raises(ConfigError, match=r"can be written by others.*SURFFOLLOW_CACHE_DIR"):
        taken()


@pytest.mark.parametrize("what", ["folder", "file", "link"])
def test_a_cache_with_something_that_others_can_change_below_it_is_passed_over(only: Path, what: str) -> None:
    below = only / "surffollow" / "forecast"
    below.mkdir(parents=True)
    for folder in (only, only / "surffollow", below):
        folder.chmod(0o755)
    assert taken() == only / "surffollow"
    if what == "folder":
        below.chmod(0o777)
    elif what == "file":
        (below / "k.nbi").touch()
        (below / "k.nbi").chmod(0o666)
    else:
        (below / "k.nbi").symlink_to("/tmp")
    assert only not in taken().parents
    if what != "link":
        (only / "surffollow").chmod(0o700)  # no other user gets there
        assert taken() == only / "surffollow"


def test_folders_of_kernels_are_private_whatever_the_umask_is(only: Path) -> None:
    before = os.umask(0)
    try:
        kernel_cache.KernelCache(only / "surffollow" / "a" / "b", "k", "stamp").save("part", "tag", b"code")
    finally:
        os.umask(before)
    assert stat.S_IMODE((only / "surffollow" / "a" / "b").stat().st_mode) == 0o700
