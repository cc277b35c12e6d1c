"""Open the inbox that belongs to a board, and see whether it still has its size."""

from __future__ import annotations

import os

from surffollow.client.board import LAYOUT_HASH, Board, check_owner
from surffollow.errors import NotReadyError
from surffollow.shm.layout_board import INBOX_MAGIC, LAYOUT_VERSION, InboxHeader, inbox_bytes
from surffollow.shm.objects import SharedObject

_HEADER = InboxHeader.struct_of("magic", "size")


def open_inbox(board: Board) -> SharedObject:
    """Map the inbox of a board's service for writing.

    Raises
    ------
    NotReadyError       it is not the board's: the service is being replaced, or must mend it
    NoPermissionError   not a member of its group, or it belongs to another user than the board
    NotRunningError, BlockError
    """
    name = f"{board.name}.inbox"
    inbox = SharedObject.open(name, writable=True)
    try:
        check_owner(inbox, board)
        if inbox.size < inbox_bytes():
            raise NotReadyError(f"block {name!r} is only {inbox.size} bytes long; the service mends it")
        magic, version, _, layout, epoch, _ = _HEADER.unpack_from(inbox.memory)
        # the board was right, so a header that is not is of another run, or scribbled on and mended soon
        if (magic, version, layout, epoch) != (INBOX_MAGIC, LAYOUT_VERSION, LAYOUT_HASH, board.epoch):
            raise NotReadyError(
                f"block {name!r} does not belong to the running service (run {epoch}, layout {layout:016x}; "
                f"expected run {board.epoch}, layout {LAYOUT_HASH:016x}); try again"
            )
    except BaseException:
        inbox.close()
        raise
    return inbox


def check_whole(inbox: SharedObject) -> None:
    """See that nobody cut the inbox short: to touch a page that is gone ends the process (SIGBUS).

    Raises
    ------
    NotReadyError   it is cut; the service gives it its size again within 50 ms
    """
    if os.fstat(inbox.fd).st_size < inbox.size:
        raise NotReadyError(f"block {inbox.name!r} was cut short; the service mends it, try again")
