"""Watch an arbiter without taking part: who holds what, its clients, its history. Nothing here waits."""

from __future__ import annotations

import mmap
import time
from typing import Any

from surffollow.arbiter import layout as al
from surffollow.arbiter.board_reader import BoardReader, Holder
from surffollow.arbiter.events import History
from surffollow.arbiter.table import STATES
from surffollow.client.latch_reader import unpack_schema
from surffollow.config.names import check_name
from surffollow.config.trusted_users import trusted_owners
from surffollow.errors import NotRunningError
from surffollow.shm.closing import Closing
from surffollow.shm.objects import SharedObject
from surffollow.units import format_ns


class ArbiterObserver(Closing):
    """Reading access to an arbiter; it follows no restart: observe anew (see `alive`).

    Examples
    --------
    >>> from surffollow.arbiter import observe
    >>> with observe("cell") as watcher:
    ...     status = watcher.status()["resources"]["robot"]
    >>> status["policy"], status["fields"], status["units"]
    ('fence', ['speed', 'turn_rate'], ['m/s', 'rad/s'])
    """

    def __init__(self, name: str, board: BoardReader) -> None:
        self.name, self.board = name, board

    @property
    def resources(self) -> tuple[str, ...]:
        """Names of the resources."""
        return self.board.names

    def alive(self) -> bool:
        """Whether the server runs.

        Returns
        -------
        bool
            False: it ended, or its process is gone
        """
        return self.board.alive()

    def holder(self, resource: str) -> Holder | None:
        """Holder of a resource, None: none.

        Parameters
        ----------
        resource : str
            name of the resource

        Returns
        -------
        Holder or None
            name, priority, token and since when; None: none
        """
        s = self.board.status(self.board.number_of(resource))
        if s["token"] == 0:
            return None
        e = self.board.entry(s["holder"])
        name = str(e["name"]) if e["number"] == s["client"] else ""
        return Holder(name, s["priority"], s["client"], s["token"], s["since_ns"])

    def history(self, *, oldest: bool = False) -> History:
        """The records from now on, or from the oldest that is kept.

        Parameters
        ----------
        oldest : bool
            begin at the oldest record that is kept

        Returns
        -------
        History
            an iterator of `HistoryEvent`
        """
        self.board.require_open()
        capacity = self.board.header["history_capacity"]
        offset = self.board.regions["history"][0]
        return History(self.board.memory, offset, capacity, self.board.names, oldest)

    def status(self) -> dict[str, Any]:
        """Everything at a glance, ready for JSON.

        Returns
        -------
        dict
            `name`, `alive`, `starting`, `epoch` and `pid` of the server, `lease_s` [s], `rounds` of its loop,
            `silent_ns` since the last of them (all else is of that round);
            `resources`: name → holder, state, queue, counters, `lost_since_ns` (0: not lost),
            `apart_since_ns` (0: its pose can be converted) and declaration;
            `combinations`: name → `parts`, and `waits_for`: parts because of which the sum is its safe
            command, each with `part`, `reason` ("lost", "required", "late" or "pose"), `since_ns`,
            `for_ns` and `remedy`;
            `clients`: a list with number, name, priority, pid and counters of each
        """
        board, h = self.board, self.board.header
        resources: dict[str, dict[str, Any]] = {}
        board.require_open()
        now = unpack_schema(al.BoardHeader, board.memory)
        for k, config in enumerate(board.resources):
            s, holder = board.status(k), self.holder(board.names[k])
            since_ns = s.pop("waiting_since_ns")
            s["waiting_ns"] = max(0, time.monotonic_ns() - since_ns) if since_ns else 0
            s["state"] = STATES[s["state"]] if 0 <= s["state"] < len(STATES) else "?"
            s["holder"] = holder.name if holder else None
            resources[board.names[k]] = s | {
                "policy": "cooperative" if config["cooperative"] else "fence",
                "fields": config["fields"].split(","),
                "units": config["units"].split(",") if config["units"] else [],
                "status_block": config["status_block"],
                "combination": config["combination"] or None,
                "lost_since_ns": max(0, now["lost_ns"][k]),
                "apart_since_ns": now["apart_ns"][k],
            }
        clients = [e for e in map(board.entry, range(al.CLIENTS)) if e["number"]]
        return {
            "name": self.name,
            "alive": board.alive(),
            "starting": board.starting(),
            "epoch": h["epoch"],
            "pid": h["server_pid"],
            "lease_s": h["lease_ns"] / 1e9,
            "rounds": now["rounds"],
            "silent_ns": max(0, time.monotonic_ns() - now["heartbeat_ns"]) if now["heartbeat_ns"] else 0,
            "resources": resources,
            "combinations": self._combinations(resources, now["heartbeat_ns"]),
            "clients": clients,
        }

    def _combinations(
        self, resources: dict[str, dict[str, Any]], round_ns: int
    ) -> dict[str, dict[str, list[Any]]]:
        """The sums, each with its parts and those that it waited for in the server's last round."""
        found: dict[str, dict[str, list[Any]]] = {}
        for config in self.board.resources:
            part, combination = str(config["name"]), str(config["combination"])
            if not combination:
                continue
            entry = found.setdefault(combination, {"parts": [], "waits_for": []})
            entry["parts"].append(part)
            s = resources[part]
            remedy = f"a client requests {part}"
            if s["lost_since_ns"]:
                reason, since_ns = "lost", s["lost_since_ns"]
                remedy += (
                    "; if the robot is safe without it: "
                    f"surffollow arbiter acknowledge {part} --name {self.name} --client CLIENT"
                )
            elif config["required"] and s["state"] == "FREE":
                reason, since_ns = "required", s["since_ns"] or self.board.header["started_ns"]
            elif s["state"] != "FREE" and round_ns >= s["command_ns"] + config["ttl_ns"]:
                reason, never = "late", s["command_ns"] == s["since_ns"]  # as the grant left it
                since_ns = s["since_ns"] if never else s["command_ns"] + config["ttl_ns"]
                remedy = (
                    f"client {s['holder']} commands {part} at least every {format_ns(config['ttl_ns'])}, "
                    "or relinquishes it"
                )
            elif s["apart_since_ns"]:
                reason, since_ns = "pose", s["apart_since_ns"]
                remedy = (
                    f"the clients of {combination}'s parts send the poses that the robot reported, or {part} "
                    "sends offsets without a pose"
                )
            else:
                continue
            for_ns = max(0, time.monotonic_ns() - since_ns)
            wait = {"part": part, "reason": reason, "since_ns": since_ns, "for_ns": for_ns, "remedy": remedy}
            entry["waits_for"].append(wait)
        return found

    def close(self) -> None:
        """Release the board; calls after it raise ClosedError."""
        self.board.close()


def observe(name: str = "cell", *, owner: int | str | None = None) -> ArbiterObserver:
    """Watch an arbiter; the board of one that has ended can be read until the next start.

    Parameters
    ----------
    name : str
        of the arbiter
    owner : int or str
        whose board to trust; as for `attach`

    Returns
    -------
    ArbiterObserver
        to be closed, or used in a `with` statement

    Raises
    ------
    NotRunningError, NoPermissionError, BlockError, LayoutMismatchError, ConfigError

    Examples
    --------
    >>> from surffollow.arbiter import observe
    >>> with observe("cell") as watcher:
    ...     watcher.alive(), "robot" in watcher.resources, watcher.holder("robot")
    (True, True, None)
    """
    try:
        obj = SharedObject.open(check_name(f"{name}.arbiter"), owners=trusted_owners(owner))
    except NotRunningError:
        raise NotRunningError(
            f"no arbiter {name!r} runs here; start it: surffollow arbiter start CONFIG.toml"
        ) from None
    try:
        memory = mmap.mmap(obj.fd, obj.size, mmap.MAP_SHARED, mmap.PROT_READ)
    finally:
        obj.close()
    return ArbiterObserver(name, BoardReader(name, memory))
