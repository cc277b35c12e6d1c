"""The folder of compiled kernels: where it is, and that no other user can write it."""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import sys
import tempfile
from functools import cache
from pathlib import Path

from surffollow.errors import ConfigError
from surffollow.shm.trusted_folder import fault_within, why_not_trusted

FRESH_IN = ("/tmp", "/var/tmp")  # where a private folder is made when TMPDIR is others', too


@cache
def cache_directory() -> str:
    """SURFFOLLOW_CACHE_DIR, NUMBA_CACHE_DIR, the user's cache, or else a temporary folder of theirs.

    A folder that another user can change, at any component of its path or below it, is passed over and
    named on stderr: what is kept in it is run.

    Raises
    ------
    ConfigError   there is no folder for it that only this user can change
    """
    home = os.environ.get("HOME", "")
    candidates = [
        os.environ.get("SURFFOLLOW_CACHE_DIR", ""),
        os.environ.get("NUMBA_CACHE_DIR", ""),
        os.environ.get("XDG_CACHE_HOME", ""),
        str(Path(home, ".cache")) if home else "",
        str(Path(tempfile.gettempdir(), f"surffollow-cache-{os.getuid()}")),
    ]
    refused: list[str] = []
    for candidate in filter(None, candidates):
        folder = Path(os.path.abspath(candidate), "surffollow")
        try:
            make_private(folder)
        except OSError as e:
            refused.append(f"{folder} cannot be made ({e.strerror})")
            continue
        fault = why_not_trusted(folder) or fault_within(folder)
        if not fault and not os.access(folder, os.W_OK):
            fault = f"{folder} cannot be written"
        if not fault:
            _say_refused(refused, folder)
            return str(folder)
        refused.append(fault)
    for place in (tempfile.gettempdir(), *FRESH_IN):
        try:
            fresh = tempfile.mkdtemp(prefix="surffollow-cache-", dir=place)
        except OSError:
            continue
        fault = why_not_trusted(fresh)  # a user who may rename in `place` can put another folder there
        if fault:
            refused.append(fault)
            with contextlib.suppress(OSError):
                os.rmdir(fresh)
            continue
        atexit.register(_remove, fresh, os.getpid())
        folder = Path(fresh, "surffollow")
        folder.mkdir(mode=0o700)
        _say_refused(refused, folder)
        return str(folder)
    raise ConfigError(
        "there is no folder for compiled kernels that only this user can change: "
        f"{'; '.join(refused) or 'none can be made'}; {_remedy()}"
    )


def make_private(folder: Path) -> None:
    """Make a folder and what is missing of the way to it, for this user alone."""
    for part in (*reversed(folder.parents), folder):
        with contextlib.suppress(FileExistsError):
            part.mkdir(mode=0o700)


def _remove(folder: str, maker: int) -> None:
    if os.getpid() == maker:  # not in a forked child
        shutil.rmtree(folder, ignore_errors=True)


def _say_refused(refused: list[str], instead: Path) -> None:
    if refused:
        with contextlib.suppress(OSError, ValueError, AttributeError):
            sys.stderr.write(
                f"surffollow: no kernel cache of this user's own: {'; '.join(refused)}; {instead} is used; "
                f"{_remedy()}\n"
            )


@cache
def say_not_kept(folder: str, reason: str) -> None:
    """Name, once, a folder in use that takes no more kernels."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        sys.stderr.write(
            f"surffollow: compiled kernels cannot be kept in {folder} ({reason}): every start compiles them "
            "again; make room there (0.1 GB), or name a folder with room: SURFFOLLOW_CACHE_DIR\n"
        )


def _remedy() -> str:
    """The remedy where folders were passed over; that of the variable, which comes first, is one of them."""
    if os.environ.get("SURFFOLLOW_CACHE_DIR"):
        return "let SURFFOLLOW_CACHE_DIR name a folder that this user can write and no other one can change"
    return "name a folder of your own: SURFFOLLOW_CACHE_DIR"
