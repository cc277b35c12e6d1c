"""Programs of this machine that send datagrams (kind = "unix"); the kernel says which user sent each."""

from __future__ import annotations

import contextlib
import os
import socket
import stat
import struct
from pathlib import Path
from typing import Any

from surffollow.config.key_errors import convert_table
from surffollow.config.trusted_users import ROOT, UNMAPPED_USER, own_user, user_id
from surffollow.errors import ConfigError, DriverError
from surffollow.hw.driver import Driver, DriverInfo
from surffollow.hw.polled import PolledDriver
from surffollow.hw.range_settings import RangeSettings
from surffollow.hw.wire.datagrams import DATAGRAM_BYTES, Datagrams, DatagramSource, bind_socket
from surffollow.hw.wire.frame_format import Format, Number, reader_of
from surffollow.shm.received_descriptors import refuse_rights

PATH_BYTES = 107
_SENDER = struct.Struct("iII")  # struct ucred: pid, uid, gid


class UnixConfig(RangeSettings, frozen=True, forbid_unknown_fields=True):
    """A sensor's program on this machine.

    Attributes
    ----------
    path : of the socket that the service makes
    users : names or numbers of users who may send, beside root and the service's own
    format : see `frame_format.Format`; a datagram holds whole frames or lines; a line may lack its terminator
    sequence : where a datagram's number is, if it is there; older ones than the last are dropped
    channels : sensors in the datagrams
    range_min_m, range_max_m, latency_s, mounts, silence_s : see `RangeSettings`
    """

    path: str
    users: tuple[str | int, ...] = ()
    format: Format = Format()
    sequence: Number | None = None
    channels: int = 1

    def __post_init__(self) -> None:
        size = len(os.fsencode(self.path))
        if not (self.path.startswith("/") and "\0" not in self.path and size <= PATH_BYTES):
            raise ConfigError(
                f"path = {self.path!r}, expected an absolute path of at most {PATH_BYTES} bytes, "
                "like /run/surffollow/laser.sock"
            )
        for user in self.users:
            try:
                user_id(user)
            except ConfigError:
                raise ConfigError(f"users: there is no user {user!r} on this machine") from None
        if self.sequence is not None:
            reader_of(self.sequence, self.format.length, "sequence", whole=True)

    @property
    def permitted(self) -> frozenset[int]:
        """Numbers of the users who may send."""
        return frozenset((ROOT, own_user(), *map(user_id, self.users))) - {UNMAPPED_USER}


class _Received:
    """Datagrams with the credentials that the kernel checked; see `datagrams.Datagrams`."""

    def __init__(self, opened: socket.socket, users: frozenset[int]) -> None:
        self.socket, self._users = opened, users

    def receive(self) -> tuple[bytes, str]:
        """The next datagram, and why its sender is refused; there is room for no descriptor."""
        data, parts, _, _ = self.socket.recvmsg(DATAGRAM_BYTES, socket.CMSG_LEN(_SENDER.size))
        for level, kind, content in parts:
            if (level, kind, len(content)) == (socket.SOL_SOCKET, socket.SCM_CREDENTIALS, _SENDER.size):
                pid, user, _ = _SENDER.unpack(content)
                if user in self._users:
                    return data, ""
                permitted = ", ".join(map(str, sorted(self._users)))
                return data, f"datagrams come from user {user} (pid {pid}), expected from {permitted} (users)"
        return data, "datagrams come from a user whom the kernel does not name"


class UnixSource(DatagramSource):
    """The socket; see `polled.Source`."""

    def __init__(self, config: UnixConfig, info: DriverInfo) -> None:
        super().__init__(f"Unix socket {config.path}", config, info)
        self._config = config
        self._made: tuple[int, int] | None = None  # device and inode of the socket's name

    def bind(self) -> Datagrams:
        """Make the socket; one that a dead service left is removed."""
        path = Path(self._config.path)
        _remove_unused(path)
        opened = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)  # before anybody can send
        refuse_rights(opened)  # to drop a descriptor may take as long as its sender likes; Linux 6.16
        bind_socket(opened, str(path))
        try:
            os.chmod(path, 0o666 if self._config.users else 0o600)
            status = os.lstat(path)
        except BaseException:
            opened.close()
            raise
        self._made = status.st_dev, status.st_ino
        return _Received(opened, self._config.permitted)

    def read(self, timeout_s: float) -> list[tuple[int, int]]:
        """Conversions; DriverError when the socket has lost its name, so that no sender finds it."""
        found = super().read(timeout_s)
        if not found and not self._has_name():
            raise DriverError("the socket was removed or replaced by something else; it is made again")
        return found

    def _has_name(self) -> bool:
        with contextlib.suppress(OSError):
            there = os.lstat(self._config.path)
            return self._made == (there.st_dev, there.st_ino)
        return False

    def close(self) -> None:
        """Remove the socket."""
        super().close()
        if self._has_name():
            os.unlink(self._config.path)
        self._made = None


def _remove_unused(path: Path) -> None:
    """Remove an own socket that nobody has open any more.

    Raises
    ------
    DriverError  something else has the name
    """
    try:
        status = os.lstat(path)
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(status.st_mode) or status.st_uid != own_user():
        raise DriverError(f"something else is at {path}; look at it (ls -l {path}), or choose another path")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            os.unlink(path)
            return
    raise DriverError("another program listens there; end it, or choose another path")


def make(settings: dict[str, Any], name: str) -> Driver:
    """Make a driver with a Unix socket from its settings."""
    config = convert_table(settings, UnixConfig)
    info = config.info(f"sensor on Unix socket {config.path}", config.channels)
    return PolledDriver(info, UnixSource(config, info), config.silence_s)
