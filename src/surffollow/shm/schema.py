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

_MAX_BYTES = 1 << 40
# code → (struct letter, size, C type)
SCALARS: dict[str, tuple[str, int, str]] = {
    "f8": ("d", 8, "double"),
    "f4": ("f", 4, "float"),
    "i8": ("q", 8, "int64_t"),
    "u8": ("Q", 8, "uint64_t"),
    "i4": ("i", 4, "int32_t"),
    "u4": ("I", 4, "uint32_t"),
    "i2": ("h", 2, "int16_t"),
    "u2": ("H", 2, "uint16_t"),
    "i1": ("b", 1, "int8_t"),
    "u1": ("B", 1, "uint8_t"),
}


class Field:
    """One field: a scalar, an array of scalars, a text of fixed bytes, or a nested schema.

    `name` and `offset` are filled in when the schema that holds it is laid out.
    """

    def __init__(
        self,
        code: str,
        count: int = 1,
        *,
        unit: str = "",
        doc: str = "",
        nested: type[Schema] | None = None,
        align: int = 0,
    ) -> None:
        if not isinstance(count, int) or count < 1:
            raise SchemaError(f"a field's count must be a whole number of at least 1, not {count!r}")
        if align and (align & (align - 1)):
            raise SchemaError(f"a field's alignment must be a power of two, not {align}")
        self.code, self.count, self.unit, self.doc = code, count, unit, doc
        self.nested, self.extra_align = nested, align
        self.name, self.offset = "", -1

    @property
    def is_text(self) -> bool:
        return self.code == "S"

    @property
    def item_size(self) -> int:
        if self.nested is not None:
            return self.nested.SIZE
        return 1 if self.is_text else SCALARS[self.code][1]

    @property
    def size(self) -> int:
        return self.item_size * self.count

    @property
    def align(self) -> int:
        own = self.nested.ALIGN if self.nested is not None else self.item_size
        return max(own, self.extra_align)

    @property
    def struct_format(self) -> str:
        """The format of this field for `struct`, without byte order."""
        if self.is_text:
            return f"{self.count}s"
        if self.nested is not None:
            return f"{self.size}s"
        return f"{self.count}{SCALARS[self.code][0]}"

    def describe(self, name: str = "") -> str:
        what = self.nested.describe() if self.nested is not None else self.code
        return f"{name or self.name}:{what}*{self.count}@{self.offset}[{self.unit}]"


def _scalar(code: str) -> Any:
    def make(count: int = 1, *, unit: str = "", doc: str = "", align: int = 0) -> Any:
        """A field of `count` numbers of this type.

        Parameters
        ----------
        count : int
            1: a number; more: an array
        unit : str
            of each number; part of the hash
        doc : str
            meaning; not part of the hash
        align : int
            least alignment [bytes]; 0: that of the type

        Returns
        -------
        Field
            to be assigned to a name in the body of a `Schema` or `Block`

        Examples
        --------
        >>> from surffollow.blocks import F64, I8, Block
        >>> class Joystick(Block):
        ...     axes = F64(6, unit="m/s, rad/s", doc="linear and angular velocity")
        ...     deadman = I8(doc="1: pressed")
        >>> Joystick.offset("deadman"), Joystick.SIZE
        (48, 56)
        """
        return Field(code, count, unit=unit, doc=doc, align=align)

    return make


F64, F32 = _scalar("f8"), _scalar("f4")
I64, U64 = _scalar("i8"), _scalar("u8")
I32, U32 = _scalar("i4"), _scalar("u4")
I16, U16 = _scalar("i2"), _scalar("u2")
I8, U8 = _scalar("i1"), _scalar("u1")


def Text(size: int, *, doc: str = "") -> Any:  # noqa: N802 - reads like the other field makers
    """UTF-8 text of at most `size` bytes, filled up with NUL.

    Parameters
    ----------
    size : int
        room [bytes]
    doc : str
        meaning; not part of the hash

    Returns
    -------
    Field
        to be assigned to a name in the body of a `Schema` or `Block`

    Examples
    --------
    >>> from surffollow.blocks import Block, Text
    >>> class Tool(Block):
    ...     serial = Text(16, doc="as engraved")
    >>> Tool.SIZE, Tool.field("serial").doc
    (16, 'as engraved')
    """
    return Field("S", size, doc=doc)


def Nested(schema: type[Schema], count: int = 1, *, doc: str = "", align: int = 0) -> Any:  # noqa: N802
    """`count` structures of another schema, one after the other.

    Parameters
    ----------
    schema : subclass of Schema
        the structure
    count : int
        1: a record; more: an array of records
    doc : str
        meaning; not part of the hash
    align : int
        least alignment [bytes]; 0: that of the structure

    Returns
    -------
    Field
        for a name in a layout's body

    Examples
    --------
    >>> from surffollow.blocks import F64, Block, Nested
    >>> class Axis(Block):
    ...     angle = F64(unit="rad")
    ...     torque = F64(unit="N m")
    >>> class Arm(Block):
    ...     axes = Nested(Axis, 5)
    >>> Arm.SIZE, Arm.offset("axes", 2, "torque")
    (80, 40)
    """
    return Field("V", count, nested=schema, doc=doc, align=align)


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
