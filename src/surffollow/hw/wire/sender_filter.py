"""A filter in the kernel for a UDP socket: datagrams of others than one sender take no room in its queue.

`connect` would do that, too, but it also binds the socket to one address of this machine: a sensor that
broadcasts would not be received any more.
"""

from __future__ import annotations

import contextlib
import ipaddress
import socket
import struct

import numpy as np

_SO_ATTACH_FILTER, _SO_DETACH_FILTER = 26, 27  # without names in Python
_LOAD_WORD, _LOAD_HALF, _IF_EQUAL, _RETURN = 0x20, 0x28, 0x15, 0x06  # classic BPF
_SOURCE_ADDRESS = 0xFFF00000 + 12  # in the IP header (SKF_NET_OFF)
_SOURCE_PORT = 0  # in the UDP header, where such a filter begins
_INSTRUCTION, _PROGRAM = struct.Struct("HBBI"), struct.Struct("HP")


def admit_only(opened: socket.socket, sender: str) -> None:
    """Take datagrams of one sender only from here on; without filters in this kernel those of all.

    Parameters
    ----------
    opened : socket.socket   UDP over IPv4
    sender : "address" or "address:port"
    """
    host, _, port = sender.partition(":")
    wanted = [(_LOAD_WORD, _SOURCE_ADDRESS, int(ipaddress.IPv4Address(host)))]
    if port:
        wanted.append((_LOAD_HALF, _SOURCE_PORT, int(port)))
    code = b""
    for left, (load, where, value) in zip(range(len(wanted), 0, -1), wanted):
        code += _INSTRUCTION.pack(load, 0, 0, where)
        code += _INSTRUCTION.pack(_IF_EQUAL, 0, 2 * left - 1, value)  # else to the last one
    code += _INSTRUCTION.pack(_RETURN, 0, 0, 0xFFFFFFFF)  # all bytes
    code += _INSTRUCTION.pack(_RETURN, 0, 0, 0)
    kept = np.frombuffer(code, np.uint8)  # until the kernel has copied it
    program = _PROGRAM.pack(len(code) // _INSTRUCTION.size, kept.ctypes.data)
    with contextlib.suppress(OSError):
        opened.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, program)


def admit_all(opened: socket.socket) -> None:
    """Take datagrams of every sender again.

    Parameters
    ----------
    opened : socket.socket
    """
    with contextlib.suppress(OSError):  # there is no filter
        opened.setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)
