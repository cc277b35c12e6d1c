"""The low-level controller's side: what a resource is to do now, or what is safe."""

from __future__ import annotations

import time
from typing import NamedTuple

from surffollow.arbiter import layout as al
from surffollow.arbiter.observer import observe
from surffollow.blocks.attached import AttachedBlock
from surffollow.config.names import check_name
from surffollow.config.trusted_users import trusted_owners
from surffollow.errors import BlockError, NoPermissionError, NotRunningError, UsageError
from surffollow.shm.closing import Closing

_RETRY_NS = 20_000_000


class ResourceCommand(NamedTuple):
    """A command.

    Attributes
    ----------
    values : tuple of floats
        as many as the resource declares; the safe ones when nothing valid is there
    safe : bool
        True: no client commands, the holder is late, or the server is gone
    seq : int
        rises with each publication; 0: none yet
    client : int
        number of the client, 0: none
    t_ns : int
        when it was made [ns]
    ref_t_ns : int
        timestamp of the pose that the values are relative to; 0: none
    limited : bool
        a value was brought within its limits

    Examples
    --------
    >>> from surffollow.arbiter import ResourceCommand
    >>> command = ResourceCommand((0.2, 0.0), False, 1, 3, t_ns=5_000_000, ref_t_ns=0, limited=False)
    >>> command.age_ns(now_ns=7_000_000)                      # [ns]
    2000000
    """

    values: tuple[float, ...]
    safe: bool
    seq: int
    client: int
    t_ns: int
    ref_t_ns: int
    limited: bool

    def age_ns(self, now_ns: int | None = None) -> int:
        """How long ago it was made [ns].

        Parameters
        ----------
        now_ns : int, optional
            at this time [ns], CLOCK_MONOTONIC; at present when absent

        Returns
        -------
        int
            age [ns]; negative: made after `now_ns`
        """
        return (time.monotonic_ns() if now_ns is None else now_ns) - self.t_ns


class CommandReader(Closing):
    """Reads the command block of one resource, or of a combination; follows restarts of the server.

    The block must belong to a trusted user when it is attached first, and to that same user ever after.

    Examples
    --------
    >>> from surffollow.arbiter import command_reader
    >>> with command_reader("cell", "robot") as reader:
    ...     command = reader.latest()
    >>> command.values if not command.safe else "stop the robot"
    'stop the robot'
    """

    def __init__(self, name: str, resource: str, owner: int | str | None = None) -> None:
        owners = trusted_owners(owner)
        self._name, self._resource, self._owner = name, resource, owner
        self._block = AttachedBlock(resource, check_name(f"{name}.{resource}"), al.Command, owners)
        self._next_try_ns = 0
        self._n, self._safe = 0, (0.0,) * al.VALUES
        try:
            self._block.attach_reader()
        except NoPermissionError:
            raise
        except NotRunningError:
            unknown = self._undeclared()
            if unknown:
                raise UsageError(unknown) from None
        except BlockError:
            pass  # a server that starts replaces what is no block of this release

    @property
    def refusal(self) -> str:
        """Why no command is read; empty: one is read, or no server has started.

        Either the block that bears the name now is not trusted, or the server declares no such resource.
        """
        return self._block.refusal or ("" if self._block.attached else self._undeclared())

    def _undeclared(self) -> str:
        """Why the server that runs has no such block; empty: it has one, or no server runs."""
        try:
            with observe(self._name, owner=self._owner) as watcher:
                names, alive = watcher.resources, watcher.alive()
        except (NotRunningError, BlockError):
            return ""
        if not alive:
            return ""
        try:
            self._block.attach_reader()  # the board does not name combinations
        except (NotRunningError, BlockError):
            return (
                f"arbiter {self._name!r} has no resource or combination {self._resource!r}; "
                f"its resources are {', '.join(names)}"
            )
        return ""

    @property
    def attached(self) -> bool:
        """Whether there is, or was, a server."""
        return self._block.attached

    def latest(self) -> ResourceCommand:
        """The newest command, or the safe one; never waits.

        Returns
        -------
        ResourceCommand
            `safe` is set when no valid command is there; before the server's first start it has no values
        """
        now = time.monotonic_ns()
        if not self._block.attached and now >= self._next_try_ns:
            self._next_try_ns = now + _RETRY_NS
            try:
                self._block.attach_reader()
            except (NotRunningError, BlockError):
                return ResourceCommand((), True, 0, 0, now, 0, False)
        snapshot = self._block.latest()
        if snapshot.generation == 0:
            return ResourceCommand(self._safe[: self._n], True, 0, 0, now, 0, False)
        c = snapshot.values
        self._n, self._safe = c.n_values, c.safe
        # a server that died cannot say that its last command is over; one of the future is of another clock
        good = c.source != al.SOURCE_SAFE and 2 * c.t_ns - c.valid_until_ns < now < c.valid_until_ns
        values = (c.value if good else c.safe)[: self._n]
        ref = c.ref_t_ns if good else 0
        return ResourceCommand(
            values, not good, c.seq, c.client, c.t_ns, ref, bool(c.flags & al.FLAG_LIMITED)
        )

    def close(self) -> None:
        """Detach."""
        self._block.close()


def command_reader(name: str, resource: str, *, owner: int | str | None = None) -> CommandReader:
    """Read what a resource of an arbiter is to do; attaches when the server appears.

    Parameters
    ----------
    name, resource : str
        arbiter, and resource or combination
    owner : int or str
        whose block to trust; as for `attach`

    Returns
    -------
    CommandReader
        to be asked by `latest`

    Raises
    ------
    UsageError
        the arbiter runs, and has no such resource or combination. Of one that starts later `refusal` says so
    NoPermissionError
        a block of another user bears the name, or its mode forbids reading
    ConfigError
        there is no user of that name

    Examples
    --------
    >>> from surffollow.arbiter import attach, command_reader
    >>> with attach("cell", "go") as arbiter, command_reader("cell", "robot") as reader:
    ...     robot = arbiter.resource("robot")
    ...     if robot.request(timeout_s=5.0) and robot.command(0.2, 0.0):
    ...         command = reader.latest()                     # a controller reads it in each cycle
    >>> len(command.values)                                   # speed [m/s], turn_rate [rad/s]
    2
    """
    return CommandReader(name, resource, owner)
