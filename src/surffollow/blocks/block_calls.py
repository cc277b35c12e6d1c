"""Functions in the paper's spelling for what is done with an attached block."""

from __future__ import annotations

from surffollow.blocks.attached import AttachedBlock
from surffollow.blocks.record import Record
from surffollow.blocks.snapshot import Snapshot


def get_read_ok(block: AttachedBlock, timeout_s: float = 5.0) -> tuple[Record, int]:
    """Wait until writing has finished; returns a read-only view and its generation.

    Parameters
    ----------
    block : AttachedBlock
        to be read, as `mem_attach` gave it
    timeout_s : float
        longest wait for the writer [s]

    Returns
    -------
    tuple of Record and int
        the view, valid until `read_done`, and its generation

    Examples
    --------
    >>> import os
    >>> from surffollow.blocks import F64, Block, get_read_ok, mem_attach, read_done
    >>> class Axes(Block):
    ...     speed = F64(unit="m/s")
    >>> with mem_attach(Axes, f"example-{os.getpid()}", write=True) as mem:
    ...     with mem.axes.write() as slot:
    ...         slot.speed = 0.5
    ...     view, generation = get_read_ok(mem.axes)      # the writer waits until `read_done`
    ...     print(view.speed, generation, read_done(mem.axes))
    0.5 1 ok
    """
    return block.get_read_ok(timeout_s)


def read_done(block: AttachedBlock) -> str:
    """End the read: "ok", or "stale" when the reader was fenced meanwhile.

    Parameters
    ----------
    block : AttachedBlock
        whose read ends

    Returns
    -------
    str
        "ok" or "stale"

    Examples
    --------
    >>> import os
    >>> from surffollow.blocks import F64, Block, get_read_ok, mem_attach, read_done
    >>> class Axes(Block):
    ...     speed = F64(unit="m/s")
    >>> with mem_attach(Axes, f"example-{os.getpid()}", write=True) as mem:
    ...     with mem.axes.write() as slot:
    ...         slot.speed = 0.5
    ...     view, generation = get_read_ok(mem.axes)
    ...     speed = view.speed
    ...     if read_done(mem.axes) == "stale":                # it took longer than the lease: read again
    ...         speed = None
    >>> speed
    0.5
    """
    return block.read_done()


def get_write_ok(block: AttachedBlock, timeout_s: float = 5.0) -> Record:
    """Wait until all reading has finished; returns a slot that holds the newest values.

    Parameters
    ----------
    block : AttachedBlock
        to be written
    timeout_s : float
        longest wait for the readers [s]

    Returns
    -------
    Record
        the slot, to be changed and published by `write_done`

    Examples
    --------
    >>> import os
    >>> from surffollow.blocks import F64, Block, get_write_ok, latest, mem_attach, write_done
    >>> class Axes(Block):
    ...     speed = F64(unit="m/s")
    >>> with mem_attach(Axes, f"example-{os.getpid()}", write=True) as mem:
    ...     slot = get_write_ok(mem.axes)
    ...     slot.speed = 0.5
    ...     print(write_done(mem.axes), latest(mem.axes)["speed"])
    1 0.5
    """
    return block.get_write_ok(timeout_s)


def write_done(block: AttachedBlock) -> int:
    """Publish, let readers in, replicate; returns the new generation.

    Parameters
    ----------
    block : AttachedBlock
        whose slot is published

    Returns
    -------
    int
        the new generation

    Examples
    --------
    >>> import os
    >>> from surffollow.blocks import F64, Block, get_write_ok, mem_attach, write_done
    >>> class Axes(Block):
    ...     speed = F64(unit="m/s")
    >>> with mem_attach(Axes, f"example-{os.getpid()}", write=True) as mem:
    ...     for speed in (0.1, 0.2):
    ...         get_write_ok(mem.axes).speed = speed
    ...         generation = write_done(mem.axes)
    >>> generation
    2
    """
    return block.write_done()


def latest(block: AttachedBlock) -> Snapshot:
    """A private copy of the newest values, at once, whatever readers and writer do.

    Parameters
    ----------
    block : AttachedBlock
        to be copied from

    Returns
    -------
    Snapshot
        a private copy; `stale` is set when it is an old one

    Examples
    --------
    >>> import os
    >>> from surffollow.blocks import F64, Block, latest, mem_attach
    >>> class Axes(Block):
    ...     speed = F64(unit="m/s")
    >>> with mem_attach(Axes, f"example-{os.getpid()}", write=True) as mem:
    ...     with mem.axes.write() as slot:
    ...         slot.speed = 0.5
    ...         before = latest(mem.axes)                     # is not kept waiting by the write
    ...     after = latest(mem.axes)
    >>> before.generation, after.generation, after["speed"]
    (0, 1, 0.5)
    """
    return block.latest()
