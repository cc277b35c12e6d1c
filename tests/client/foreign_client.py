"""A client made of the JSON of `surffollow print-header --json` and the rules of docs/reference/protocol.md.

Run as `python -I -S foreign_client.py LAYOUT NAME`; it imports the standard library alone. Each line of its
input is a JSON list, a verb and its arguments; each line of its output is the answer. Comments name the
rule that a step follows. Memory is looked at word by word as on x86-64, where a fence is no instruction.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import mmap
import os
import socket
import struct
import sys
import time
from typing import Any

LAYOUT: dict[str, Any] = {}
LETTERS = {"int64": "q", "uint64": "Q", "double": "d", "int32": "i", "uint32": "I", "float": "f"}
LETTERS |= {"int16": "h", "uint16": "H", "int8": "b", "uint8": "B"}
F_GET_SEALS = 1034


class RefusedError(Exception):
    """The service, or a rule, says no."""


def hex64(text: str) -> int:
    return int(text, 16)


def unpack(struct_name: str, memory: Any, at: int = 0) -> dict[str, Any]:
    """A structure as the JSON describes it."""
    out: dict[str, Any] = {}
    for f in LAYOUT["structs"][struct_name]["fields"]:
        start, count = at + f["offset"], f["count"]
        if f["type"] == "char":
            out[f["name"]] = bytes(memory[start : start + f["bytes"]]).split(b"\0")[0].decode()
        elif f["type"] in LETTERS:
            values = struct.unpack_from(f"<{count}{LETTERS[f['type']]}", memory, start)
            out[f["name"]] = values[0] if count == 1 else list(values)
        else:
            step = f["bytes"] // count
            items = [unpack(f["type"], memory, start + k * step) for k in range(count)]
            out[f["name"]] = items[0] if count == 1 else items
    return out


def pack(struct_name: str, **values: Any) -> bytes:
    """The bytes of a structure; what is not given is 0."""
    shape = LAYOUT["structs"][struct_name]
    data = bytearray(shape["bytes"])
    for f in shape["fields"]:
        value = values.pop(f["name"], None)
        if value is None:
            continue
        if f["type"] == "char":
            text = value.encode()[: f["bytes"] - 1]
            data[f["offset"] : f["offset"] + len(text)] = text
        else:
            many = value if isinstance(value, list) else [value]
            struct.pack_into(f"<{len(many)}{LETTERS[f['type']]}", data, f["offset"], *many)
    assert not values, f"{struct_name} has no {list(values)}"
    return bytes(data)


def copy_at(struct_name: str, generation: int) -> int:
    """Where in a latch the copy of a generation lies."""
    latch = LAYOUT["latch"]
    step = -(-LAYOUT["structs"][struct_name]["bytes"] // 64) * 64
    return int(latch["copies_at"] + generation % latch["copies"] * step)


class Shared:
    """A mapping, and the latches in it."""

    def __init__(self, memory: mmap.mmap) -> None:
        self.memory, self.words = memory, memoryview(memory).cast("q")

    def read(self, struct_name: str, at: int) -> dict[str, Any] | None:
        """R1 to R4."""
        for _ in range(LAYOUT["latch"]["max_tries"]):
            g = self.words[at // 8]
            if g == 0:
                return None
            start = at + copy_at(struct_name, g)
            data = bytes(self.memory[start : start + LAYOUT["structs"][struct_name]["bytes"]])
            if self.words[at // 8] - g <= LAYOUT["latch"]["whole_while_grown_by"]:
                return unpack(struct_name, data)
        return None

    def write(self, struct_name: str, at: int, **values: Any) -> None:
        """W1 to W3; the generation goes on from the one that lies there."""
        g = self.words[at // 8] + 1
        data = pack(struct_name, **values)
        start = at + copy_at(struct_name, g)
        self.memory[start : start + len(data)] = data
        self.words[at // 8] = g


class Board(Shared):
    """*Attaching*, steps 1 to 4."""

    def __init__(self, name: str) -> None:
        place = LAYOUT["objects"]["board"]
        self.path = place["path"].replace("NAME", name)
        fd = os.open(self.path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            found = os.fstat(fd)
            self.owner, self.inode = found.st_uid, (found.st_dev, found.st_ino)
            if found.st_uid not in (0, os.geteuid()):
                raise RefusedError(f"the board belongs to user {found.st_uid}")
            super().__init__(mmap.mmap(fd, found.st_size, mmap.MAP_SHARED, mmap.PROT_READ))
        finally:
            os.close(fd)
        header = unpack(place["header"]["struct"], self.memory)
        states = LAYOUT["enums"]["board_state"]
        if header["state"] < states["STATE_READY"] or header["magic"] != hex64(place["magic"]["value"]):
            raise RefusedError("the board is not ready")
        header = unpack(place["header"]["struct"], self.memory)
        if header["version"] != place["version"] or header["layout_hash"] != hex64(place["hash"]):
            raise RefusedError("the board is of another release")
        self.epoch, self.period_ns = header["epoch"], header["period_ns"]
        at = {r["name"]: r["offset"] for r in header["region"]}
        self.parts = {p["name"]: (at[p["name"]], p) for p in place["parts"]}

    def part(self, name: str, index: int = 0) -> dict[str, Any] | None:
        at, p = self.parts[name]
        if p["kind"] == "plain":
            return unpack(p["struct"], self.memory, at)
        return self.read(p["struct"], at + index * p["stride"])

    def is_current(self) -> bool:
        with contextlib.suppress(OSError):
            found = os.stat(self.path)
            return (found.st_dev, found.st_ino) == self.inode
        return False


class Slot(Shared):
    """*Getting a slot*, S1 to S5."""

    def __init__(self, name: str, board: Board, label: str) -> None:
        place = self.place = LAYOUT["handshake"]
        self.steps = {m["name"]: m["step"] for m in place["messages"]}
        self.socket = socket.socket(getattr(socket, place["family"]), getattr(socket, place["type"]))
        self.socket.settimeout(LAYOUT["waits"]["slot_wait_ns"] / 1e9)
        try:
            self.socket.connect(place["path"].replace("NAME", name))
            peer = self.socket.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)
            if struct.unpack("3i", peer)[1] != board.owner:
                raise RefusedError("another user listens there")
            self._say("SLOT_ASK", epoch=board.epoch, name=label)
            offer, fds = self._receive("SLOT_OFFER")
            try:
                size = os.fstat(fds[0]).st_size
                if fcntl.fcntl(fds[0], F_GET_SEALS) & place["seals"] != place["seals"]:
                    raise RefusedError("the slot is not sealed")
                if size != LAYOUT["objects"]["slot"]["bytes"]:
                    raise RefusedError("the slot has another size")
                super().__init__(mmap.mmap(fds[0], size))
            finally:
                for fd in fds:
                    os.close(fd)
            self.number, self.claim = offer["slot"], offer["claim"]
            self._say("SLOT_MAPPED", slot=self.number, claim=self.claim)
            self._receive("SLOT_GRANT")
            self.socket.setblocking(False)  # a look at it never waits
        except BaseException:
            self.socket.close()
            raise
        self.parts = {p["name"]: p for p in LAYOUT["objects"]["slot"]["parts"]}
        self.counter = 0

    def _say(self, step: str, **fields: Any) -> None:
        known = {
            "magic": hex64(self.place["magic"]["value"]),
            "layout_hash": hex64(self.place["hash"]),
        }
        self.socket.send(pack(self.place["struct"], step=self.steps[step], **known, **fields))

    def _receive(self, step: str) -> tuple[dict[str, Any], list[int]]:
        size = LAYOUT["structs"][self.place["struct"]]["bytes"]
        data, fds, _, _ = socket.recv_fds(self.socket, size, 1, socket.MSG_CMSG_CLOEXEC)
        if len(data) != size:
            raise RefusedError("the service closed the connection")
        message = unpack(self.place["struct"], data)
        if message["step"] == self.steps["SLOT_REFUSE"]:
            raise RefusedError(LAYOUT["slot_refusals"][message["result"]]["text"])
        if message["step"] != self.steps[step]:
            raise RefusedError(f"step {message['step']} out of turn")
        return message, list(fds)

    def is_open(self) -> bool:
        try:
            return self.socket.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) != b""
        except BlockingIOError:
            return True
        except OSError:
            return False

    def post(self, part: str, **values: Any) -> None:
        p = self.parts[part]
        self.write(p["struct"], p["offset"], **values)


class Client:
    """Memory and sockets that the commands use."""

    def __init__(self, name: str) -> None:
        self.name, self.label = name, f"foreign {os.getpid()}"
        self.board = Board(name)
        self.slot: Slot | None = None
        self.requests = {r["name"]: r for r in LAYOUT["requests"]}
        self.answers = {a["result"]: a["name"] for a in LAYOUT["answers"]}
        self.status_bits = LAYOUT["bits"]["sf_output.status"]

    # -- verbs ----------------------------------------------------------------------------------

    def demand(self) -> dict[str, Any]:
        """*Poses and demands*: valid when VALID is set and it is not stale; else six zeros."""
        output = self.board.part("output")
        waits = LAYOUT["waits"]
        period_ns, least = self.board.period_ns, waits["stale_least_periods"]
        most = max(min(waits["stale_periods"] * period_ns, waits["stale_max_ns"]), least * period_ns)
        limit = max(most, waits["stale_min_ns"], PATIENT_NS)
        stale = output is None or time.monotonic_ns() - output["t_ns"] > limit
        if stale:
            self._follow()
        status = 0 if output is None else output["status"]
        if stale:
            status = status & ~(1 << self.status_bits["VALID"]) | 1 << self.status_bits["STALE"]
        valid = bool(status >> self.status_bits["VALID"] & 1)
        place = {k: output[k] for k in ("pose_t_ns", "epoch", "cycle")} if output else {}
        return {
            "valid": valid,
            "status": [n for n, bit in self.status_bits.items() if status >> bit & 1],
            "demand": output["demand"] if output and valid else [0.0] * 6,
            "stop": [
                n for n, b in LAYOUT["bits"]["sf_output.stop"].items() if output and output["stop"] >> b & 1
            ],
            "range_m": output["range_m"][0] if output and output["range_m"][0] > 0 else None,
            **place,
        }

    def attach(self) -> list[int]:
        if self.slot is None:
            self.slot = Slot(self.name, self.board, self.label)
        return [self.slot.number, self.slot.claim]

    def leave(self) -> None:
        """To leave, close the connection."""
        if self.slot is not None:
            self.slot.socket.close()
            self.slot = None

    def pose(self, *pose: float) -> int:
        t_ns = time.monotonic_ns()
        self._held().post("pose", t_ns=t_ns, pose=list(pose))
        return t_ns

    def params(self) -> dict[str, Any]:
        """Parameters in force, by the numbers and types that the JSON gives."""
        at, part = self.board.parts["params"]
        values = self.board.read(part["struct"], at) or {}
        data = pack(part["struct"], **values)
        found = {}
        for p in LAYOUT["parameters"]:
            (found[p["name"]],) = struct.unpack_from("<" + LETTERS[p["type"]], data, 8 * p["number"])
        return found

    def request(self, name: str, values: dict[str, Any]) -> list[Any]:
        """*Requests*: the arguments go where the JSON says; result and detail of the last answer."""
        ticket = self._post_request(name, values)
        result, detail = self._answer("acks", ticket)
        if self.answers[result] == "ACCEPTED":
            result, detail = self._answer("map_acks", ticket)
        return [self.answers[result], detail]

    def install(self, values: dict[str, Any], heights: list[int], counts: list[int]) -> list[Any]:
        """MAP_INSTALL of a map that fits into one piece."""
        ticket = self._post_request("MAP_INSTALL", values)
        result, detail = self._answer("acks", ticket)
        if self.answers[result] != "ACCEPTED":
            return [self.answers[result], detail]
        result, taken = self._answer("map_acks", ticket)
        if self.answers[result] == "ACCEPTED":  # its turn: piece 1 goes into the second half
            slot = self._held()
            piece = slot.parts["stream1"]
            at, n = piece["offset"], len(heights)
            head = pack(piece["struct"], counter=ticket, claim=slot.claim, start=0, n=n)
            slot.memory[at + 8 : at + len(head)] = head[8:]
            first = at + piece["heights_at"]
            slot.memory[first : first + 2 * n] = struct.pack(f"<{n}h", *heights)
            first = at + piece["counts_at"]
            slot.memory[first : first + n] = bytes(counts)
            slot.words[at // 8] = 1  # `sequence` is stored last
        while self.answers[result] == "ACCEPTED":  # a piece was taken, the end is to come
            time.sleep(0.0005)
            result, taken = self._answer("map_acks", ticket)
        return [self.answers[result], taken]

    def set_params(self, values: dict[str, float]) -> list[Any]:
        numbers = {p["name"]: p["number"] for p in LAYOUT["parameters"]}
        return self.request(
            "SET_PARAMS", {"parameter": [numbers[n] for n in values], "value": list(values.values())}
        )

    def enter(self) -> bool:
        """*Exclusive access*, step 1, and whether step 2 was seen."""
        access, slot = LAYOUT["enums"]["access"], self._held()
        status = self.board.part("map_status") or {}
        fenced = status["fenced"] >> slot.number & 1
        slot.words[slot.parts["head"]["offset"] // 8] = access[
            "ACCESS_FREE" if fenced else "ACCESS_REQUESTED"
        ]
        return self._granted()

    def exit(self) -> bool:
        """Steps 3 and 4: 3 in the slot, and 0 when the service was seen to go on."""
        access, slot = LAYOUT["enums"]["access"], self._held()
        word, held = slot.parts["head"]["offset"] // 8, self._granted()
        slot.words[word] = access["ACCESS_DONE"]
        end = time.monotonic() + WAIT_S
        while self._granted() and time.monotonic() < end:
            time.sleep(0.0005)
        slot.words[word] = access["ACCESS_FREE"]
        return held

    def map(self) -> dict[str, Any]:
        """Geometry, and the first grids' heights, of a map that is not being laid anew."""
        place = LAYOUT["objects"]["map"]
        with open(place["path"].replace("NAME", self.name), "rb") as f:
            if os.fstat(f.fileno()).st_uid != self.board.owner:
                raise RefusedError("the map belongs to another user")
            memory = mmap.mmap(f.fileno(), 0, mmap.MAP_SHARED, mmap.PROT_READ)
        for _ in range(1000):
            header = unpack(place["header"]["struct"], memory)
            if header["layout_hash"] != hex64(place["hash"]) or header["magic"] != hex64(
                place["magic"]["value"]
            ):
                raise RefusedError("the map is of another release")
            grids = [self._height(memory, header, i) for i in range(min(8, header["nx"] * header["ny"]))]
            again = unpack(place["header"]["struct"], memory)["generation"]
            if again == header["generation"] and again % 2 == 0:
                geometry = {k: v for k, v in header.items() if not k.startswith(("journal_", "dirty"))}
                return {**geometry, "grids": grids}
            time.sleep(0.001)
        raise RefusedError("the map is being laid anew")

    def _height(self, memory: Any, header: dict[str, Any], grid: int) -> float | None:
        """Height [m] of a grid: grid i lies in pair i / 2."""
        place = LAYOUT["objects"]["map"]
        pairs = place["pairs"]
        h = unpack(pairs["struct"], memory, pairs["offset"] + grid // 2 * pairs["stride"])["h"][grid % 2]
        return None if h == place["unknown_height"] else header["datum_m"] + header["quantum_m"] * h

    # -- beneath --------------------------------------------------------------------------------

    def _held(self) -> Slot:
        if self.slot is not None and not self.slot.is_open():
            self.leave()
        if self.slot is None:
            raise RefusedError("no slot: attach")
        return self.slot

    def _granted(self) -> bool:
        status, slot = self.board.part("map_status"), self._held()
        holder = (LAYOUT["enums"]["access"]["ACCESS_GRANTED"], slot.number, slot.claim)
        return (
            status is not None and (status["access"], status["access_slot"], status["access_claim"]) == holder
        )

    def _post_request(self, name: str, values: dict[str, Any]) -> int:
        slot, request = self._held(), self.requests[name]
        limits = LAYOUT["limits"]["request_args"]
        words: dict[str, list[Any]] = {"number": [0] * limits, "value": [0.0] * limits}
        n = 0
        for a in request["arguments"]:
            given = values[a["name"]]
            given = given if isinstance(given, list) else [given]
            if a["count"] == "n":
                n = len(given)
            words[a["array"]][a["first"] : a["first"] + len(given)] = given
        slot.counter += 1
        slot.post("request", counter=slot.counter, code=request["code"], n=n, claim=slot.claim, **words)
        return slot.counter

    def _answer(self, part: str, counter: int) -> tuple[int, int]:
        """An answer counts when it bears this counter and this claim."""
        slot, end = self._held(), time.monotonic() + WAIT_S
        while time.monotonic() < end:
            ack = self.board.part(part, slot.number)
            if ack and (ack["counter"], ack["claim"]) == (counter, slot.claim):
                return ack["result"], ack["detail"]
            if not slot.is_open():
                raise RefusedError("the service ended before it answered")
            time.sleep(0.0005)
        raise RefusedError(f"no answer in {part}")

    def _follow(self) -> None:
        """*Identity, death and restart*: another inode that is READY is attached to."""
        if not self.board.is_current():
            with contextlib.suppress(RefusedError, OSError):
                board = Board(self.name)
                self.leave()
                self.board = board


PATIENT_NS = 200_000_000  # a busy machine
WAIT_S = 60.0


def main() -> None:
    with open(sys.argv[1], encoding="utf-8") as file:
        LAYOUT.update(json.load(file))
    client = Client(sys.argv[2])
    print(json.dumps({"epoch": client.board.epoch}), flush=True)
    for line in sys.stdin:
        verb, *words = json.loads(line)
        try:
            answer: Any = {"is": getattr(client, verb)(*words)}
        except (RefusedError, OSError) as e:
            answer = {"error": str(e)}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
