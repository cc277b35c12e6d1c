"""Shared memory for cooperating programs: typed blocks, one writer each, any number of readers.

from surffollow.blocks import F64, I64, Block, mem_attach

class Joystick(Block):
    '''What the operator asks for.'''
    deadman = I64(doc="1: pressed")
    axes = F64(6, unit="m/s, rad/s")

mem = mem_attach(Joystick, "cell", write=True)
with mem.joystick.write() as slot:
    slot.deadman, slot.axes = 1, [0.1, 0, 0, 0, 0, 0]

Light (no NumPy, no numba); see docs/reference/blocks.md.
"""

from __future__ import annotations

from surffollow.blocks.attached import AttachedBlock
from surffollow.blocks.block_calls import get_read_ok, get_write_ok, latest, read_done, write_done
from surffollow.blocks.memory import Memory, block_name, mem_attach
from surffollow.blocks.record import Record
from surffollow.blocks.snapshot import Snapshot
from surffollow.shm.schema import F32, F64, I8, I16, I32, I64, U8, U16, U32, U64, Nested, Text
from surffollow.shm.schema import Schema as Block

__all__ = [
    "F32",
    "F64",
    "I8",
    "I16",
    "I32",
    "I64",
    "U8",
    "U16",
    "U32",
    "U64",
    "AttachedBlock",
    "Block",
    "Memory",
    "Nested",
    "Record",
    "Snapshot",
    "Text",
    "block_name",
    "get_read_ok",
    "get_write_ok",
    "latest",
    "mem_attach",
    "read_done",
    "write_done",
]
