"""Client of an arbiter: attach, heartbeat, resources."""

from __future__ import annotations

import contextlib
import mmap
import os
import select
import threading
import time
import weakref

from surffollow.arbiter import layout as al
from surffollow.arbiter.board_reader import BoardReader
from surffollow.arbiter.exchange import Exchange
from surffollow.arbiter.handshake import MailboxGrant, confirm_mapping, request_slot
from surffollow.arbiter.observer import ArbiterObserver, observe
from surffollow.arbiter.resource import Resource
from surffollow.config.names import check_name
from surffollow.config.trusted_users import trusted_owners
from surffollow.errors import FaultError, NotRunningError, RefusedError

HEARTBEATS_PER_LEASE = 5
ATTACH_POLL_S = 0.02
EXIT_GRACE_S = 0.3


class ArbiterClient(ArbiterObserver):
    """A client with a slot of its own; a thread shows that it lives; one other thread at a time may use it.

    Attributes
    ----------
    client : str
        its name in the configuration
    number : int
        as in the history
    owner : int
        user of the server's process, from the kernel

    Examples
    --------
    >>> from surffollow.arbiter import attach
    >>> with attach("cell", "go") as arbiter:
    ...     reply = arbiter.resource("robot").request(timeout_s=5.0)
    ...     holder = arbiter.holder("robot")
    >>> reply.granted, holder.name, holder.priority
    (True, 'go', 10)
    """

    def __init__(self, name: str, client: str, grant: MailboxGrant) -> None:
        mailbox, board = grant.fds
        super().__init__(name, BoardReader(name, mmap.mmap(board, 0, mmap.MAP_SHARED, mmap.PROT_READ)))
        self.client, self.number, self.slot, self.owner = client, grant.number, grant.slot, grant.owner
        self._grant = grant
        self.exchange = Exchange(name, grant.slot, self.board, mmap.mmap(mailbox, al.MAILBOX_BYTES))
        os.close(mailbox)
        os.close(board)
        grant.fds.clear()
        confirm_mapping(grant.sock, name)
        self._heartbeat_s = self.board.header["lease_ns"] / 1e9 / HEARTBEATS_PER_LEASE
        self._thread = threading.Thread(target=self._send_heartbeats, name="arbiter heartbeat", daemon=True)
        self._thread.start()
        _clients.add(self)

    @property
    def connected(self) -> bool:
        """Whether the server is there and this client was not closed."""
        return not self.exchange.ended

    def resource(self, name: str) -> Resource:
        """A resource by its name.

        Parameters
        ----------
        name : str
            of the resource, as configured

        Returns
        -------
        Resource
            handle of the resource

        Raises
        ------
        UsageError
            no resource has this name
        """
        return Resource(self, self.exchange, self.board.number_of(name))

    def _send_heartbeats(self) -> None:
        poll = select.poll()
        poll.register(self._grant.sock.fileno(), select.POLLIN)
        while not self.exchange.closed:
            self.exchange.send_heartbeat()
            # the server never writes: only its end makes the socket readable
            if poll.poll(self._heartbeat_s * 1e3):
                self.exchange.ended = True
                return

    def reattach(self, *, timeout_s: float = 5.0) -> ArbiterClient:
        """Attach anew under the same names, to a server of the same user only; this client is closed.

        Parameters
        ----------
        timeout_s : float
            how long to wait for a server that has not started [s]

        Returns
        -------
        ArbiterClient
            the new attachment

        Raises
        ------
        NotRunningError, RequestTimeoutError, NoPermissionError, RefusedError, ConfigError
            as `attach`

        Notes
        -----
        Every token is void: request the resources again.
        """
        self.close()
        return attach(self.name, self.client, timeout_s=timeout_s, owner=self.owner)

    def close(self) -> None:
        """End: everything that this client holds or waits for is given up."""
        if self.exchange.closed:
            return
        self.exchange.closed = True
        with contextlib.suppress(OSError):
            self._grant.sock.shutdown(2)
        self.exchange.ended = True
        self._thread.join(1.0)
        self._grant.sock.close()
        # mappings stay until the last handle goes: a thread may still look at `held`


_clients: weakref.WeakSet[ArbiterClient] = weakref.WeakSet()


def _close_in_child() -> None:
    # the connection is the parent's life: a child must not keep it
    for client in list(_clients):
        client.exchange.ended = client.exchange.closed = True
        with contextlib.suppress(OSError):
            client._grant.sock.close()


os.register_at_fork(after_in_child=_close_in_child)


def _require_reachable(name: str, owner: int | str | None) -> None:
    """Raise NotRunningError with another reason when the server runs, and its socket is not found here."""
    try:
        with observe(name, owner=owner) as watcher:
            alive, pid = watcher.alive(), watcher.board.header["server_pid"]
    except FaultError:
        return
    if alive:
        raise NotRunningError(
            f"arbiter {name!r} runs (process {pid}), and its socket is not found here, perhaps because it is "
            "in another network namespace; run this program in that one (containers: the same network)"
        )


def attach(
    name: str, client: str, *, timeout_s: float = 5.0, owner: int | str | None = None
) -> ArbiterClient:
    """Attach to an arbiter under a name that its configuration declares.

    Parameters
    ----------
    name : str
        of the arbiter
    client : str
        its priority is the configuration's
    timeout_s : float
        how long to wait for a server that has not started
    owner : int or str
        number or name of the user whose server to trust; None: this process's own, root's,
        or that of the user that SURFFOLLOW_OWNER names

    Returns
    -------
    ArbiterClient
        to be closed, or used in a `with` statement

    Raises
    ------
    NotRunningError
        no server in that time
    RequestTimeoutError
        a server that does not answer: its process is stopped or gets no processor time
    NoPermissionError
        a process of another user bears the arbiter's name
    RefusedError
        unknown or taken name, no free slot, not a user who may
    ConfigError
        there is no user of that name

    Examples
    --------
    >>> from surffollow.arbiter import attach
    >>> with attach("cell", "go") as arbiter:
    ...     arbiter.client, arbiter.connected
    ('go', True)
    """
    check_name(f"{name}.arbiter")
    check_name(client)
    owners = trusted_owners(owner)
    began = time.monotonic()
    deadline = began + timeout_s
    while True:
        try:
            return ArbiterClient(name, client, request_slot(name, client, timeout_s, owners))
        except NotRunningError:
            if time.monotonic() >= deadline:
                _require_reachable(name, owner)
                raise
        except RefusedError as e:
            # a client that ended just now holds its name until the server has let it go
            if e.code not in (al.HELLO_TAKEN, al.HELLO_FULL) or time.monotonic() - began > EXIT_GRACE_S:
                raise
        time.sleep(ATTACH_POLL_S)
