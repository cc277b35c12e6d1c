"""A structure in memory as an object with its fields: no NumPy unless `numpy()` is asked for."""

from __future__ import annotations

import struct
from typing import Any

from surffollow.errors import BlockError, SchemaError
from surffollow.shm.schema import SCALARS, Field, Schema

# field name → (how to read and write it, its field)
_PLANS: dict[type[Schema], dict[str, tuple[struct.Struct, Field]]] = {}
RESERVED = frozenset(("as_dict", "array", "numpy", "update"))


def plan(schema: type[Schema]) -> dict[str, tuple[struct.Struct, Field]]:
    """How to read each field.

    Raises
    ------
    SchemaError
        a field bears the name of one of `Record`'s own methods
    """
    found = _PLANS.get(schema)
    if found is None:
        for f in schema.FIELDS:
            if f.name in RESERVED:
                raise SchemaError(
                    f"a block's field cannot be called {f.name!r}; that is a method of its records"
                )
            if f.nested is not None:
                plan(f.nested)
        found = {f.name: (struct.Struct("<" + f.struct_format), f) for f in schema.FIELDS}
        _PLANS[schema] = found
    return found


class Record:
    """The fields of one structure, read from memory at each access.

    Scalars are numbers, texts are `str`, arrays are tuples (copies), nested schemas are
    records. Writable ones take assignments: `slot.speed = 0.2`, `slot.axes = [0] * 6`.
    `slot.array("axes")[2] = 0.1` changes one element in place.

    Examples
    --------
    >>> import os
    >>> from surffollow.blocks import F64, Block, Text, mem_attach
    >>> class Arm(Block):
    ...     angles = F64(3, unit="rad")
    ...     tool = Text(16)
    >>> with mem_attach(Arm, f"example-{os.getpid()}", write=True) as mem:
    ...     with mem.arm.write() as slot:
    ...         slot.update(angles=[0.1, 0.2, 0.3], tool="laser")
    ...         slot.array("angles")[2] = 0.0
    ...     print(mem.arm.latest().values.as_dict())
    {'angles': [0.1, 0.2, 0.0], 'tool': 'laser'}
    """

    __slots__ = ("_base", "_buffer", "_plan", "_schema")
    _buffer: Any
    _base: int
    _schema: type[Schema]
    _plan: dict[str, tuple[struct.Struct, Field]]

    def __init__(self, schema: type[Schema], buffer: Any, base: int) -> None:
        put = object.__setattr__
        put(self, "_schema", schema)
        put(self, "_buffer", buffer)
        put(self, "_base", base)
        put(self, "_plan", plan(schema))

    def _end(self) -> None:
        object.__setattr__(self, "_buffer", None)

    def _find(self, name: str) -> tuple[struct.Struct, Field]:
        if self._buffer is None:
            raise BlockError("this view is over: read_done or write_done was called; take a new one")
        return self._plan[name]

    def _get(self, name: str) -> Any:
        how, f = self._find(name)
        at = self._base + f.offset
        if f.nested is not None:
            items = tuple(Record(f.nested, self._buffer, at + k * f.item_size) for k in range(f.count))
            return items if f.count > 1 else items[0]
        values = how.unpack_from(self._buffer, at)
        if f.is_text:
            return values[0].split(b"\0", 1)[0].decode("utf-8", "replace")
        return values if f.count > 1 else values[0]

    def _set(self, name: str, value: Any) -> None:
        how, f = self._find(name)
        if f.nested is not None:
            raise TypeError(f"{name} is a structure: assign its fields, or use update({name}={{...}})")
        at = self._base + f.offset
        try:
            if f.is_text:
                data = value.encode() if isinstance(value, str) else bytes(value)
                if len(data) > f.count:
                    raise ValueError(f"{name} holds {f.count} bytes of UTF-8, not {len(data)}")
                how.pack_into(self._buffer, at, data)
            elif f.count > 1:
                if len(value) != f.count:
                    raise ValueError(f"{name} holds {f.count} values, not {len(value)}")
                how.pack_into(self._buffer, at, *value)
            else:
                how.pack_into(self._buffer, at, value)
        except struct.error as e:
            raise ValueError(f"{self._schema.__name__}.{name} cannot hold {value!r}: {e}") from None
        except TypeError as e:
            if getattr(self._buffer, "readonly", True):
                raise TypeError(
                    "this view is read-only; only get_write_ok gives one that can be changed"
                ) from None
            raise TypeError(f"{self._schema.__name__}.{name} cannot hold {value!r}: {e}") from None

    def __getattr__(self, name: str) -> Any:
        try:
            return self._get(name)
        except KeyError:
            raise AttributeError(f"block {self._schema.__name__} has no field {name!r}") from None

    def __setattr__(self, name: str, value: Any) -> None:
        try:
            self._set(name, value)
        except KeyError:
            raise AttributeError(f"block {self._schema.__name__} has no field {name!r}") from None

    def __getitem__(self, name: str) -> Any:
        return self._get(name)

    def __setitem__(self, name: str, value: Any) -> None:
        self._set(name, value)

    def __dir__(self) -> list[str]:
        return [*self._plan, *sorted(RESERVED)]

    def __repr__(self) -> str:
        if self._buffer is None:
            return f"<{self._schema.__name__}, over>"
        return f"{self._schema.__name__}({', '.join(f'{n}={self._get(n)!r}' for n in self._plan)})"

    def update(self, **values: Any) -> None:
        """Assign several fields; a nested schema takes a dictionary.

        Parameters
        ----------
        values : any
            fields by name

        Raises
        ------
        AttributeError
            no field of that name
        ValueError
            a value does not fit its field
        TypeError
            the view is read-only, or a value has the wrong type
        """
        for name, value in values.items():
            if isinstance(value, dict):
                getattr(self, name).update(**value)
            else:
                setattr(self, name, value)

    def as_dict(self) -> dict[str, Any]:
        """All fields as plain values.

        Returns
        -------
        dict
            numbers, text, lists, dictionaries by name of the field

        Raises
        ------
        BlockError
            the view is over: `read_done` or `write_done` was called
        """
        from surffollow.client.latch_reader import unpack_schema

        if self._buffer is None:
            raise BlockError("this view is over: read_done or write_done was called; take a new one")
        return unpack_schema(self._schema, self._buffer, self._base)

    def array(self, name: str) -> Any:
        """A field of numbers as a view of the memory itself.

        Parameters
        ----------
        name : str
            of a field of numbers

        Returns
        -------
        memoryview
            shape (count,), of the numbers; not to be used after the end of the view

        Raises
        ------
        TypeError
            it is a structure or a text
        BlockError
            the view is over
        """
        _, f = self._find(name)
        if f.nested is not None or f.is_text:
            raise TypeError(f"{name} is not a field of numbers")
        start = self._base + f.offset
        letter: Any = SCALARS[f.code][0]
        return memoryview(self._buffer)[start : start + f.size].cast("B").cast(letter)

    def numpy(self) -> Any:
        """The structure as a NumPy record of the memory itself.

        Returns
        -------
        numpy.void
            structured; not to be used after the end of the view

        Raises
        ------
        BlockError
            the view is over
        """
        import numpy as np

        from surffollow.shm.dtypes import numpy_dtype

        self._find(self._schema.FIELDS[0].name)
        return np.frombuffer(self._buffer, numpy_dtype(self._schema), 1, self._base)[0]
