"""Attach several blocks at once, and the paper's spellings of what is done with them."""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Iterator, Mapping

from surffollow.blocks.attached import AttachedBlock
from surffollow.config.group_id import group_id
from surffollow.config.names import OBJECTS, check_name
from surffollow.config.trusted_users import trusted_owners
from surffollow.errors import InvalidNameError, NotRunningError, SchemaError
from surffollow.shm.closing import Closing
from surffollow.shm.schema import Schema

Blocks = type[Schema] | Iterable[type[Schema]] | Mapping[str, type[Schema]]
ATTACH_POLL_S = 0.005
_TAKEN = frozenset(OBJECTS)  # the service's own objects are called NAME.map, NAME.sock, …


def block_name(schema: type[Schema]) -> str:
    """The name a block has when none is given: `StateVector` → `state_vector`.

    Parameters
    ----------
    schema : subclass of Block
        the declaration

    Returns
    -------
    str
        name of the block

    Examples
    --------
    >>> from surffollow.blocks import I64, Block, block_name
    >>> class StateVector(Block):
    ...     mode = I64()
    >>> block_name(StateVector)
    'state_vector'
    """
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", schema.__name__).lower()


class Memory(Closing):
    """All blocks of one `mem_attach`, as attributes and by name; closes them when it ends.

    Attributes
    ----------
    name : str
        of the memory; its objects are NAME.BLOCK

    Examples
    --------
    >>> import os
    >>> from surffollow.blocks import F64, Block, mem_attach
    >>> class Axes(Block):
    ...     speed = F64(unit="m/s")
    >>> class Gripper(Block):
    ...     width = F64(unit="m")
    >>> with mem_attach([Axes, Gripper], f"example-{os.getpid()}", write=True) as mem:
    ...     mem["gripper"].name, mem["gripper"] is mem.gripper
    ('gripper', True)
    """

    def __init__(self, name: str, blocks: dict[str, AttachedBlock]) -> None:
        self.name, self._blocks = name, blocks

    def __getattr__(self, name: str) -> AttachedBlock:
        try:
            return self.__dict__["_blocks"][name]  # type: ignore[no-any-return]
        except KeyError:
            raise AttributeError(
                f"no block {name!r} was attached; there are {sorted(self._blocks)}"
            ) from None

    def __getitem__(self, name: str) -> AttachedBlock:
        return self._blocks[name]

    def __iter__(self) -> Iterator[AttachedBlock]:
        return iter(self._blocks.values())

    def __len__(self) -> int:
        return len(self._blocks)

    def close(self, *, keep: bool = False) -> None:
        """Detach all; blocks written here lose their names unless `keep`.

        Parameters
        ----------
        keep : bool
            keep the name, so that the next writer continues the block
        """
        for block in self:
            block.close(keep=keep)


def mem_attach(
    blocks: Blocks,
    name: str = "blocks",
    *,
    write: bool | Iterable[str | type[Schema]] = (),
    timeout_s: float = 5.0,
    lazy: bool = False,
    mode: int = 0o640,
    group: str = "",
    lease_s: float = 0.5,
    owner: int | str | None = None,
) -> Memory:
    """Attach blocks: map them, check their schema hashes, become the writer of some.

    Parameters
    ----------
    blocks : a schema, several, or {block name: schema}
        declared by subclasses of `Block`; without a name, a block is called after its class:
        `StateVector` → `state_vector`
    name : str
        of the memory; its objects are NAME.BLOCK
    write : bool or names or schemas
        which of them this process writes (True: all); absent ones are made, dead writers' ones taken over
    timeout_s : float
        how long to wait for blocks whose writers have not started
    lazy : bool
        do not wait for them: they attach when they appear
    mode : int
        permissions of blocks written here, for example 0o640
    group : str
        of blocks written here: name or number of the group that may read them; "": that of this process
    lease_s : float
        of blocks written here: how long a reader may hold up a waiting writer
    owner : int or str
        of blocks read here: number or name of the user whose they must be; None: this process's own, root,
        or the user that SURFFOLLOW_OWNER names. Another one's is refused then and later

    Returns
    -------
    Memory
        with the blocks as attributes

    Raises
    ------
    BusyError
        another live process writes such a block; its pid is named
    LayoutMismatchError
        a block was declared otherwise
    NotRunningError
        a block did not appear in time
    ValueError
        `lease_s` or `mode` is out of bounds
    NoSpaceError
        /dev/shm cannot hold a block
    NoPermissionError
        a block belongs to another user, or its mode forbids reading
    InvalidNameError
        (a ValueError) no name that a block can have, or no such group
    SchemaError
        `write` names no block, or two blocks would have one name

    Examples
    --------
    >>> import os
    >>> from surffollow.blocks import F64, Block, mem_attach
    >>> class Axes(Block):
    ...     speed = F64(unit="m/s")
    >>> with mem_attach(Axes, f"example-{os.getpid()}", write=True) as mem:
    ...     with mem.axes.write() as slot:
    ...         slot.speed = 0.5
    ...     mem.axes.latest()["speed"]
    0.5
    """
    named = _named(blocks)
    writes = _chosen(write, named)
    if not 0.001 <= lease_s <= 3600.0:
        raise ValueError(f"lease_s must be 0.001 to 3600 s, not {lease_s!r}")
    if mode & ~0o666 or mode & 0o600 != 0o600:
        raise ValueError(f"mode must give its owner 0o600 and nobody more than 0o666, not {mode:#o}")
    group_number = group_id(group, InvalidNameError(f"there is no group {group!r}"))
    owners = trusted_owners(owner)
    attached: dict[str, AttachedBlock] = {}
    deadline = time.monotonic() + timeout_s
    try:
        # what we write first: others may be waiting for it while we wait for theirs
        for block in sorted(named, key=lambda n: n not in writes):
            attached[block] = one = AttachedBlock(block, _object_name(name, block), named[block], owners)
            if block in writes:
                one.attach_writer(mode, group_number, round(lease_s * 1e9))
            else:
                _attach_reader(one, deadline, lazy)
    except BaseException:
        for one in attached.values():
            one.close(keep=True)
        raise
    return Memory(name, {n: attached[n] for n in named})


def _named(blocks: Blocks) -> dict[str, type[Schema]]:
    if isinstance(blocks, type):
        blocks = [blocks]
    if isinstance(blocks, Mapping):
        return dict(blocks)
    named: dict[str, type[Schema]] = {}
    for schema in blocks:
        if named.setdefault(block_name(schema), schema) is not schema:
            raise SchemaError(f"two blocks would be called {block_name(schema)!r}; pass {{name: schema}}")
    return named


def _chosen(write: bool | Iterable[str | type[Schema]], named: dict[str, type[Schema]]) -> set[str]:
    if isinstance(write, bool):
        return set(named) if write else set()
    items = [write] if isinstance(write, str | type) else list(write)
    chosen: set[str] = set()
    for item in items:
        found = {n for n, s in named.items() if item in (n, s)}
        if not found:
            raise SchemaError(f"write names {item!r}, which is none of the blocks {sorted(named)}")
        chosen |= found
    return chosen


def _object_name(name: str, block: str) -> str:
    if block in _TAKEN:
        raise InvalidNameError(f"a block cannot be called {block!r}; a service has an object of that name")
    return check_name(f"{name}.{block}")


def _attach_reader(block: AttachedBlock, deadline: float, lazy: bool) -> None:
    while True:
        try:
            return block.attach_reader()
        except NotRunningError:
            if lazy:
                return None
            if time.monotonic() >= deadline:
                raise
        time.sleep(ATTACH_POLL_S)
