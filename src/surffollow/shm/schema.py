"""Declare a memory layout once, as a Python class with typed fields and units.

The class gives the byte offsets (C natural alignment, little-endian), the `struct`
format, the NumPy dtype (`surffollow.shm.dtypes`), the C header and a hash that
readers compare before they trust a block. No NumPy here: clients import this.

    class Pose(Schema):
        \"\"\"Where the tool is.\"\"\"
        t_ns = I64(unit="ns", doc="when it was true, CLOCK_MONOTONIC")
        xyz_m = F64(3, unit="m", doc="world from tool")
"""

from __future__ import annotations

import hashlib
import keyword
import struct
from collections.abc import Iterator
from typing import Any, ClassVar

from surffollow.errors import SchemaError
from surffollow.shm.schema_field import (
    F32,
    F64,
    I8,
    I16,
    I32,
    I64,
    SCALARS,
    U8,
    U16,
    U32,
    U64,
    Field,
    Nested,
    Text,
)

# a layout is declared with the names of this module alone
__all__ = [
    "F32",
    "F64",
    "I8",
    "I16",
    "I32",
    "I64",
    "SCALARS",
    "U8",
    "U16",
    "U32",
    "U64",
    "Field",
    "Nested",
    "Schema",
    "Text",
]

_MAX_BYTES = 1 << 40


class Schema:
    """Base of every layout; subclasses list their fields as class attributes.

    Raises
    ------
    SchemaError
        at class creation: no fields, a name that C or Python cannot use, or a size over 1 TiB.

    Examples
    --------
    >>> from surffollow.blocks import F64, I64, Block
    >>> class Pose(Block):
    ...     t_ns = I64(unit="ns", doc="CLOCK_MONOTONIC")
    ...     xyz_m = F64(3, unit="m", doc="world from tool")
    >>> Pose.SIZE, Pose.offset("xyz_m", 1), Pose.field("xyz_m").unit
    (32, 16, 'm')
    >>> Pose.describe()
    'Pose(32;t_ns:i8*1@0[ns];xyz_m:f8*3@8[m])'
    """

    FIELDS: ClassVar[tuple[Field, ...]] = ()
    SIZE: ClassVar[int] = 0
    ALIGN: ClassVar[int] = 1
    HASH: ClassVar[int] = 0
    # names in the hash of fields, and of the class (""), that were renamed since: the layout is the same
    HASHED_AS: ClassVar[dict[str, str]] = {}

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        fields = [(n, f) for n, f in vars(cls).items() if isinstance(f, Field)]
        if not fields:
            raise SchemaError(f"schema {cls.__name__} declares no fields")
        offset, align = 0, 1
        for name, f in fields:
            if keyword.iskeyword(name) or name.startswith("_") or not name.isascii():
                raise SchemaError(f"field name {cls.__name__}.{name} cannot be used in Python and C")
            f.name = name
            f.offset = -(-offset // f.align) * f.align
            offset, align = f.offset + f.size, max(align, f.align)
        cls.FIELDS = tuple(f for _, f in fields)
        cls.ALIGN = align
        cls.SIZE = -(-offset // align) * align
        if cls.SIZE > _MAX_BYTES:
            raise SchemaError(f"schema {cls.__name__} would take {cls.SIZE} bytes; the limit is {_MAX_BYTES}")
        cls.HASH = int.from_bytes(hashlib.blake2b(cls.describe().encode(), digest_size=8).digest(), "little")

    @classmethod
    def describe(cls) -> str:
        """The canonical text that the hash is made of: names, types, offsets, units."""
        fields = ";".join(f.describe(cls.HASHED_AS.get(f.name, "")) for f in cls.FIELDS)
        return f"{cls.HASHED_AS.get('', cls.__name__)}({cls.SIZE};{fields})"

    @classmethod
    def field(cls, name: str) -> Field:
        """A field by its name.

        Parameters
        ----------
        name : str
            of the field

        Returns
        -------
        Field
            with offset, size, unit and meaning

        Raises
        ------
        SchemaError
            no field of that name
        """
        for f in cls.FIELDS:
            if f.name == name:
                return f
        raise SchemaError(f"schema {cls.__name__} has no field {name!r}")

    @classmethod
    def offset(cls, *path: str | int) -> int:
        """Byte offset of a field, through nested schemas and indices: `offset("slot", 3, "pid")`.

        Parameters
        ----------
        path : str or int
            names of fields and indices, in order

        Returns
        -------
        int
            from the beginning of the structure [bytes]
        """
        at, schema, field = 0, cls, None
        for step in path:
            if isinstance(step, int):
                if field is None or not 0 <= step < field.count:
                    raise SchemaError(f"index {step} is outside {cls.__name__}{list(path)}")
                at += step * field.item_size
                continue
            if field is not None:
                if field.nested is None:
                    raise SchemaError(f"{cls.__name__}{list(path)} goes into a scalar")
                schema = field.nested
            field = schema.field(step)
            at += field.offset
        return at

    @classmethod
    def struct_of(cls, first: str, last: str) -> struct.Struct:
        """A `struct.Struct` over a run of fields, padding included.

        Parameters
        ----------
        first : str
            name of the first field
        last : str
            name of the last field

        Returns
        -------
        struct.Struct
            little-endian
        """
        parts, at, started = ["<"], 0, False
        for f in cls.FIELDS:
            if f.name == first:
                started, at = True, f.offset
            if started:
                parts.append("x" * (f.offset - at) + f.struct_format)
                at = f.offset + f.size
            if f.name == last:
                return struct.Struct("".join(parts))
        raise SchemaError(f"schema {cls.__name__} has no run {first}..{last}")

    @classmethod
    def walk(cls, prefix: str = "", base: int = 0) -> Iterator[tuple[str, int, Field]]:
        """Every leaf field; nested arrays give their element 0.

        Parameters
        ----------
        prefix : str
            put before each name
        base : int
            added to each offset [bytes]

        Returns
        -------
        iterator of (str, int, Field)
            dotted name, byte offset and field
        """
        for f in cls.FIELDS:
            name, at = f"{prefix}{f.name}", base + f.offset
            if f.nested is None:
                yield name, at, f
            else:
                yield from f.nested.walk(f"{name}[0]." if f.count > 1 else f"{name}.", at)
