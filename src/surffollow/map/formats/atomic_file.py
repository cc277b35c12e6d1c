"""Write a file so that others see the old one or the whole new one: temporary file, fsync, rename."""

from __future__ import annotations

import contextlib
import os
import secrets
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from surffollow.errors import MapCancelledError, MapFileError, UsageError

FilePath = str | os.PathLike[str]
_LINKS = 40  # as many as the kernel follows
_SHARED = stat.S_ISVTX | stat.S_IWOTH  # a folder in which all users make names, and remove only their own
Progress = Callable[[float], object]
"""Called with the finished fraction, 0 … 1; returning False (not None) cancels."""


@contextmanager
def replacing(path: FilePath) -> Iterator[Path]:
    """A temporary path beside `path`; on a clean exit it is fsynced and takes its name, else it goes.

    A file that was there keeps its mode, a new one gets that of the umask; no other user reads it before.

    Raises
    ------
    MapFileError
        the directory cannot be written, the disk is full, or the name belongs to no plain file
    """
    # named before it is made: an interrupt at any moment finds what to remove
    target, temporary = _names(path)
    try:
        _make(target, temporary)
        mode = _mode_for(target)
        yield temporary
        _sync(temporary, mode)
        temporary.replace(target)
        _sync(target.parent)
    except OSError as e:
        raise MapFileError(f"cannot write {target}: {e.strerror or e}") from e
    finally:
        _remove(temporary)


def check_place(path: FilePath) -> None:
    """Fail before long work when `replacing` could not even begin to write there.

    Raises
    ------
    MapFileError
        as `replacing`
    """
    target, temporary = _names(path)
    try:
        _make(target, temporary)
    finally:
        _remove(temporary)


def check_not_read(out: FilePath, *read: FilePath | None) -> None:
    """Refuse to write over a file that the work reads, under any name.

    Raises
    ------
    UsageError
        `out` is one of the files `read` (None: no file)
    """
    for source in read:
        with contextlib.suppress(OSError):  # one of them is not there
            if source is not None and os.path.samefile(out, source):
                raise UsageError(f"{out} would replace {source}, which is read; choose another name to write")


def _names(path: FilePath) -> tuple[Path, Path]:
    """The file and its temporary one."""
    # functions of os.path: a place that cannot be looked at is refused by `_make`, with the reason
    target = Path(path)
    if os.path.exists(target) and not os.path.isfile(target):
        # renaming over a device or a pipe would take its place
        raise MapFileError(f"{target} is there and is no plain file; choose another name")
    target = behind_links(target)
    # a name as long as the file system takes has a shorter temporary one
    return target, target.with_name(f".{target.name[:50]}.{secrets.token_hex(8)}{target.suffix[-50:]}")


def behind_links(path: Path) -> Path:
    """The file that a name leads to, by the links that the kernel follows (`fs.protected_symlinks`).

    In a folder such as /tmp another user's link does not choose which file of ours is replaced. The kernel
    sees no link, because the file is renamed to what it leads to.

    Raises
    ------
    MapFileError  a link of another user in a shared folder, or one that leads nowhere
    """
    target = path
    for _ in range(_LINKS):
        try:
            if not os.path.islink(target):
                return target
            if (owner := stranger_in_shared_folder(target)) >= 0:
                raise MapFileError(
                    f"cannot write {path}: {target} is a link of user {owner}; choose another name"
                )
            target = target.parent / os.readlink(target)
        except OSError as e:
            raise MapFileError(f"cannot write {path}: {e.strerror or e}; choose another name") from e
    raise MapFileError(f"cannot write {path}: it leads through too many links; choose another name")


def stranger_in_shared_folder(target: Path) -> int:
    """The owner of a link or file in a folder such as /tmp, neither this user nor that of the folder; -1."""
    owner, folder = os.lstat(target).st_uid, os.stat(target.parent)
    shared = folder.st_mode & _SHARED == _SHARED
    return owner if shared and owner not in (os.geteuid(), folder.st_uid) else -1


def _make(target: Path, temporary: Path) -> None:
    try:
        with contextlib.suppress(FileNotFoundError):
            os.stat(target)  # a name that the file system does not take
        os.close(os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600))
    except OSError as e:
        raise MapFileError(
            f"cannot write beside {target}: {e.strerror or e}; choose another place or name"
        ) from e


def _remove(temporary: Path) -> None:
    """Remove the temporary file; where it was never made, the reason for that is the error to raise."""
    with contextlib.suppress(OSError):
        temporary.unlink()


def _mode_for(target: Path) -> int:
    try:
        return stat.S_IMODE(target.stat().st_mode) & 0o777
    except FileNotFoundError:
        mask = os.umask(0)
        os.umask(mask)
        return 0o666 & ~mask


def _sync(path: Path, mode: int | None = None) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        if mode is not None:
            os.fchmod(handle, mode)
        os.fsync(handle)
    finally:
        os.close(handle)


def report(progress: Progress | None, fraction: float) -> None:
    """Report to the caller; raise MapCancelledError when it answers False."""
    if progress is not None and progress(fraction) is False:
        raise MapCancelledError("cancelled by the caller; no file was changed")
