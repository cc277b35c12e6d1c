"""State of a service as any attachment reads it: newest output, parameters, clients, audit trail."""

from __future__ import annotations

from typing import Any

from surffollow.client.board import Board
from surffollow.errors import BlockError
from surffollow.shm.layout_board import CLIENTS, ClientInfo
from surffollow.shm.layout_follow import Output, Params


class ServiceState:
    """The methods of every attachment that read the state of the service."""

    name: str
    board: Board

    def _require_service(self) -> None:
        """Raise NotRunningError when the service ended; see `Observer`."""
        raise NotImplementedError

    def output(self) -> dict[str, Any] | None:
        """Everything that the newest cycle published.

        Returns
        -------
        dict or None
            fields of `Output` (docs/reference/layout.md) by name; None before the first cycle

        Raises
        ------
        NotRunningError
            the service ended; one that stands still leaves its last output, see `t_ns` in it
        """
        self._require_service()
        return self.board.latch("output", Output).read()

    def params(self) -> dict[str, float | int]:
        """The parameters in force.

        Returns
        -------
        dict
            name → value in SI units, times in ns (docs/reference/parameters.md)

        Raises
        ------
        NotRunningError
            the service ended
        BlockError
            it has published no parameters yet
        """
        from surffollow.config.params import PARAMS

        self._require_service()
        values = self.board.latch("params", Params).read()
        if values is None:
            raise BlockError(f"service {self.name!r} has published no parameters yet")
        return {n: values[n] for n in PARAMS}

    def clients(self) -> list[dict[str, Any]]:
        """Clients that hold slots, as the kernel reported them to the service.

        Returns
        -------
        list of dict
            slot, pid, uid, since_ns (CLOCK_MONOTONIC [ns]), and the name that the client gave itself
        """
        found = []
        for slot in range(CLIENTS):
            info = self.board.latch("clients", ClientInfo, slot).read()
            if info and info["pid"]:
                facts = {k: info[k] for k in ("pid", "uid", "since_ns", "name")}
                found.append({"slot": slot, **facts})
        return found

    def audit(self) -> list[dict[str, Any]]:
        """Changes that clients asked for, oldest first: who, what, when, with what result; also of a service
        that has ended.

        Returns
        -------
        list of dict
            the newest `AUDIT_ENTRIES` at most: pid, uid, client, request, parameter, old, new,
            result, t_ns (CLOCK_MONOTONIC), age_s, and causes and reason of stops
        """
        from surffollow.client.audit import read_audit

        return read_audit(self.board)
