"""Messages between one client and the server: items go into the mailbox, answers come on the board.

For one thread at a time, beside the one that shows life.
"""

from __future__ import annotations

import mmap
import struct
import time

from surffollow.arbiter import layout as al
from surffollow.arbiter.board_reader import BoardReader
from surffollow.arbiter.python_futex import Waiter, address_of, waker
from surffollow.client.fence import FENCED, fence
from surffollow.errors import ClosedError, NotRunningError, RequestTimeoutError
from surffollow.shm.latch_shape import HEAD_BYTES, SLOTS, stride

_GRANTS = -(-al.ClientGrants.SIZE // 64) * 64
_ENTRY = -(-al.ClientEntry.SIZE // 64) * 64
_CONSUMED = al.ClientEntry.offset("consumed")
_GRANTS_DOORBELL, _HELD, _ASKED = (al.ClientGrants.offset(n) for n in ("doorbell", "held", "asked"))
HEARTBEAT, HEAD, DOORBELL = (al.Mailbox.offset(n) // 8 for n in ("heartbeat_ns", "head", "doorbell"))
ITEMS = al.Mailbox.offset("item")
ITEM_BYTES, MASK = al.Item.SIZE, al.MAILBOX_ITEMS - 1
_HEADS = struct.Struct("<5q")  # of an item: the values of a request mean nothing
COMMAND = struct.Struct(f"<5q{al.VALUES}d")
COMMAND_AT_POSE = struct.Struct(f"<5q{al.VALUES}d{al.POSE}d")
RESULT, TOKEN, HOLDER, HOLDER_PRIORITY = (  # of an answer, in words; the item's number comes first
    al.Reply.offset(n) // 8 for n in ("result", "token", "holder", "holder_priority")
)
_REPLY_WORDS, _HEAD_WORDS, _LAST_SLOT = stride(al.Reply.SIZE) // 8, HEAD_BYTES // 8, SLOTS - 1
_clock = time.monotonic_ns
ROOM_TIMEOUT_NS, WAIT_SLICE_NS = 1_000_000_000, 50_000_000


class Exchange:
    """One client's mailbox, and its places on the board.

    Attributes
    ----------
    words : memoryview   the board as words of 64 bits
    mailbox_words : memoryview   the mailbox as words of 64 bits
    mailbox : mmap.mmap  the mailbox
    wake_server : callable       wakes the server after a change of the doorbell
    consumed : int       index in `words` of the number of items that the server took
    ended : bool         the server ended, or this client was closed
    """

    def __init__(self, name: str, slot: int, board: BoardReader, mailbox: mmap.mmap) -> None:
        self.name, self._board, self.mailbox = name, board, mailbox
        self.words: memoryview = board.words
        self.mailbox_words = memoryview(mailbox).cast("q")
        self.ended = self.closed = False
        regions = board.regions
        self._grants = regions["grants"][0] + slot * _GRANTS
        self.consumed = (regions["clients"][0] + slot * _ENTRY + _CONSUMED) // 8
        self._doorbell = (self._grants + _GRANTS_DOORBELL) // 8
        base = (regions["replies"][0] + slot * al.REPLY_BYTES) // 8
        self._reply, self._replies = base, base + _HEAD_WORDS
        self._sleep = Waiter(address_of(board.memory) + self._grants + _GRANTS_DOORBELL).wait
        self.wake_server = waker(address_of(mailbox) + 8 * DOORBELL)

    def grant_words(self, resource: int) -> tuple[int, int]:
        """Indices in `words` of the token that is held of a resource, and of the wish to have it back."""
        return (self._grants + _HELD) // 8 + resource, (self._grants + _ASKED) // 8 + resource

    def require_connection(self) -> None:
        """Raise ClosedError or NotRunningError when there is no server."""
        if self.closed:
            raise ClosedError("this client was closed; attach again")
        if self.ended:
            raise NotRunningError(
                f"arbiter {self.name!r} ended; attach again and ask again: every token is void"
            )

    def send(self, what: int, now_ns: int) -> int:
        """Put a request or relinquishment into the mailbox and ring; its number. Raises as `request`."""
        mailbox_words = self.mailbox_words
        if self.ended:
            self.require_connection()
        head = mailbox_words[HEAD]
        if head - self.words[self.consumed] >= al.MAILBOX_ITEMS:
            self._wait_for_room(head)
        seq: int = head + 1
        _HEADS.pack_into(self.mailbox, ITEMS + (head & MASK) * ITEM_BYTES, seq, what, 0, now_ns, 0)
        if FENCED:
            fence()
        mailbox_words[HEAD] = seq  # an item shows life as well as a heartbeat does
        if FENCED:
            fence()
        mailbox_words[DOORBELL] = seq
        self.wake_server()
        return seq

    def request(self, what: int, timeout_ns: int) -> int:
        """Put a request or relinquishment into the mailbox, ring, and wait for the answer to it.

        Returns
        -------
        int   index in `words` of the answer, which stays until this client asks again; -1: none in time

        Raises
        ------
        NotRunningError, ClosedError   no server answers
        RequestTimeoutError            the mailbox stays full
        """
        words = self.words
        doorbell, now = words[self._doorbell], _clock()
        seq = self.send(what, now)
        while True:
            # R1-R4 of the latch; one that is overtaken is read again
            g = words[self._reply]
            if FENCED:
                fence()
            at = self._replies + (g & _LAST_SLOT) * _REPLY_WORDS
            if words[at] == seq:
                return at
            left = now + timeout_ns - _clock()
            if left <= 0:
                return -1
            self._sleep(doorbell, left if left < WAIT_SLICE_NS else WAIT_SLICE_NS)
            if self.ended:
                self.require_connection()
            doorbell = words[self._doorbell]

    def wait_for_word(self, index: int, timeout_ns: int) -> int:
        """Wait until a word of this client's `ClientGrants` is not zero; its value, 0: too late."""
        words, deadline_ns = self.words, _clock() + timeout_ns
        while True:
            doorbell = words[self._doorbell]
            if words[index] != 0:
                return int(words[index])
            self.require_connection()
            left = deadline_ns - _clock()
            if left <= 0:
                return 0
            self._sleep(doorbell, min(left, WAIT_SLICE_NS))

    def _wait_for_room(self, head: int) -> None:
        deadline = _clock() + ROOM_TIMEOUT_NS
        while head - self.words[self.consumed] >= al.MAILBOX_ITEMS:
            self.require_connection()
            if _clock() > deadline:
                raise RequestTimeoutError(f"arbiter {self.name!r} takes nothing from this client's mailbox")
            self.wake_server()
            time.sleep(0.001)

    def send_heartbeat(self) -> None:
        """Show that this client lives."""
        self.mailbox_words[HEARTBEAT] = _clock()
