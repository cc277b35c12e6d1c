"""The exchange that gives a client its slot, step by step, with the descriptor that a client closes."""

from __future__ import annotations

import contextlib
import mmap
import select
import socket
from collections.abc import Callable

from second_user import OtherUser
from surffollow.client.board import Board
from surffollow.client.start_wait import LAYOUT_HASH
from surffollow.service.slot_server import MAX_PENDING_PER_USER
from surffollow.shm import layout_slot as ls
from surffollow.shm.unix_socket import new_socket, socket_path

MESSAGE = ls.SlotMessage.struct_of("magic", "name")


def raw_slot(name: str) -> tuple[socket.socket, int, mmap.mmap, int]:
    """Connection, descriptor, mapping and number of a slot of the service `name`, as an attacker gets it."""
    sock = new_socket()
    sock.connect(str(socket_path(name)))
    board = Board(name)
    epoch = board.epoch
    board.close()
    fields = [ls.SLOT_MAGIC, LAYOUT_HASH, ls.SLOT_ASK, epoch, 0, 0, 0, 0, b"attacker"]
    sock.send(MESSAGE.pack(*fields))
    data, fds, _, _ = socket.recv_fds(sock, MESSAGE.size, 1)
    _, _, step, _, result, _, slot, claim, _ = MESSAGE.unpack(data)
    assert step == ls.SLOT_OFFER, ls.SLOT_TEXT[result]
    memory = mmap.mmap(fds[0], ls.SLOT_BYTES)
    fields[2], fields[6], fields[7] = ls.SLOT_MAPPED, slot, claim
    sock.send(MESSAGE.pack(*fields))
    assert MESSAGE.unpack(sock.recv(MESSAGE.size))[2] == ls.SLOT_GRANT
    return sock, fds[0], memory, slot


def fill_silent_connections(path: str) -> Callable[[OtherUser], str]:
    """Work of a user who keeps as many silent connections as he may have, renewing those that are closed."""

    def work(child: OtherUser) -> str:
        socks: list[socket.socket] = []
        answered = False
        while True:
            for sock in list(socks):
                with contextlib.suppress(BlockingIOError):
                    if sock.recv(1) == b"":
                        socks.remove(sock)
                        sock.close()
            while len(socks) < MAX_PENDING_PER_USER:
                sock = new_socket()
                sock.connect(path)
                sock.setblocking(False)
                socks.append(sock)
            if not answered:
                child.say("attacks")
                answered = True
            select.select(socks, [], [])  # until one is closed

    return work
