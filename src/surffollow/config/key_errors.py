"""Word msgspec's errors by the keys and tables of a TOML file."""

from __future__ import annotations

import difflib
import re
import typing
from collections.abc import Mapping
from typing import Any

import msgspec

_T = typing.TypeVar("_T", bound=msgspec.Struct)

_AT = r"(?: - at `\$\.?(?P<path>[^`]*)`)?$"
_UNKNOWN = re.compile(r"Object contains unknown field `(?P<key>[^`]*)`" + _AT)
_MISSING = re.compile(r"Object missing required field `(?P<key>[^`]*)`" + _AT)
_OTHER = re.compile(r"(?P<text>Expected .*) - at `\$\.?(?P<path>[^`]+)`$")

_CHOICE = re.compile(r"Invalid enum value '(?P<value>[^']*)' - at `\$\.?(?P<path>[^`]+)`$")

_TOML_WORDS = {"object": "a table", "array": "a list", "null": "nothing"}


def convert_table(table: Mapping[str, Any], kind: type[_T]) -> _T:
    """Convert a table to a structure; errors are in the terms of a TOML file.

    Raises
    ------
    msgspec.ValidationError
        its text is that of `key_error_text`
    """
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        raise msgspec.ValidationError(key_error_text(error, kind, table)) from error


def key_error_text(
    error: msgspec.ValidationError,
    kind: type[msgspec.Struct] | None = None,
    data: Mapping[str, Any] | None = None,
) -> str:
    """The error in the terms of a TOML file, with the keys to choose from.

    Parameters
    ----------
    error : of `msgspec.convert`
    kind : the structure that was converted to; None: without its keys
    data : what was converted; None: tables whose names are free are called NAME

    Returns
    -------
    str
        such as "key 'grid' of [map] is unknown; did you mean 'grids'?"
    """
    text = str(error)
    if found := _UNKNOWN.match(text):
        of, hint = _of(_named(found["path"], kind, data)), _hint(found["key"], found["path"], kind)
        return f"key {found['key']!r}{of} is unknown{hint}"
    if found := _MISSING.match(text):
        return f"key {found['key']!r}{_of(_named(found['path'], kind, data))} is missing"
    if found := _CHOICE.match(text):
        *tables, name = re.findall(r"\w+", found["path"])
        table = _table(kind, tables)
        fields = msgspec.structs.fields(table) if table is not None else ()
        choices = next((typing.get_args(f.type) for f in fields if f.encode_name == name), ())
        either = f"; it is {' or '.join(repr(c) for c in choices)}" if choices else ""
        return f"key {found['path']}: {found['value']!r} is no choice{either}"
    if found := _OTHER.match(text):
        said = found["text"][0].lower() + found["text"][1:]
        for json_word, toml_word in _TOML_WORDS.items():
            said = said.replace(f"`{json_word}`", toml_word)
        return f"key {_named(found['path'], kind, data)}: {said.replace('`', '')}"
    return text


def _of(path: str | None) -> str:
    return f" of [{path}]" if path else ""


def _named(path: str | None, kind: type[msgspec.Struct] | None, data: Mapping[str, Any] | None) -> str | None:
    """The path with the name of the first table that is wrong for [...], or NAME if it is not found."""
    before, anywhere, after = (path or "").partition("[...]")
    if not anywhere:
        return path
    names = [f for f in msgspec.structs.fields(kind) if f.encode_name == before] if kind else []
    tables = data.get(before) if data is not None else None
    wrong = "NAME"
    if names and isinstance(tables, Mapping):
        element = typing.get_args(names[0].type)[-1]
        wrong = next((name for name, table in tables.items() if not _is(table, element)), wrong)
    return f"{before}.{wrong}{after.replace('[...]', '.NAME')}"


def _is(table: Any, kind: Any) -> bool:
    try:
        msgspec.convert(table, kind)
    except msgspec.ValidationError:
        return False
    return True


def _hint(key: str, path: str | None, kind: type[msgspec.Struct] | None) -> str:
    table = _table(kind, re.findall(r"\w+", path or ""))
    if table is None:
        return ""
    keys = [field.encode_name for field in msgspec.structs.fields(table)]
    if not keys:
        return "; it has no keys"
    near = difflib.get_close_matches(key, keys, n=1)
    return f"; did you mean {near[0]!r}?" if near else f"; the keys are {', '.join(keys)}"


def _table(kind: type[msgspec.Struct] | None, names: list[str]) -> type[msgspec.Struct] | None:
    """The structure at a path of keys; None where it leads through a dictionary or list."""
    for name in names:
        field = (
            next((f for f in msgspec.structs.fields(kind) if f.encode_name == name), None) if kind else None
        )
        options = (field.type, *typing.get_args(field.type)) if field else ()
        kind = next((t for t in options if isinstance(t, type) and issubclass(t, msgspec.Struct)), None)
    return kind
