"""NumPy's view of a schema: the same offsets, as a structured dtype."""

from __future__ import annotations

from typing import Any

import numpy as np

from surffollow.shm.schema import Schema

_CACHE: dict[type[Schema], np.dtype[Any]] = {}


def numpy_dtype(schema: type[Schema]) -> np.dtype[Any]:
    """The structured dtype whose offsets and size are the schema's own.

    Parameters
    ----------
    schema : type[Schema]

    Returns
    -------
    numpy.dtype
        little-endian, `itemsize == schema.SIZE`
    """
    if schema in _CACHE:
        return _CACHE[schema]
    formats: list[Any] = []
    for f in schema.FIELDS:
        if f.nested is not None:
            base: Any = numpy_dtype(f.nested)
        elif f.is_text:
            formats.append(np.dtype(f"S{f.count}"))
            continue
        else:
            base = np.dtype("<" + f.code if f.item_size > 1 else f.code)
        formats.append(np.dtype((base, (f.count,))) if f.count > 1 else base)
    _CACHE[schema] = np.dtype(
        {
            "names": [f.name for f in schema.FIELDS],
            "formats": formats,
            "offsets": [f.offset for f in schema.FIELDS],
            "itemsize": schema.SIZE,
        },
        align=False,
    )
    return _CACHE[schema]


def zeros(schema: type[Schema], count: int = 1) -> np.ndarray[Any, np.dtype[Any]]:
    """`count` zeroed records of the schema, shape (count,)."""
    return np.zeros(count, dtype=numpy_dtype(schema))
