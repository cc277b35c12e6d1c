"""Fields of a memory layout: scalars, arrays, texts and nested structures, with units.

A layout assigns them to names in the body of a `Schema`, which fills in their offsets.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from surffollow.errors import SchemaError

if TYPE_CHECKING:
    from surffollow.shm.schema import Schema

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
