"""Docstrings of the public interface name every parameter and every result."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from public_names import PACKAGES, public_names


def public(package: str) -> Iterator[Callable[..., Any]]:
    """Functions, and methods of classes, that a package offers."""
    for _, thing in public_names(package):
        if not isinstance(thing, type):
            yield inspect.unwrap(thing)
        elif not issubclass(thing, Exception):
            for base in thing.__mro__:
                for word, method in vars(base).items():
                    function = getattr(method, "__func__", method)
                    if word[0] != "_" and inspect.isfunction(function):
                        yield inspect.unwrap(function)


def section(doc: str, name: str) -> str:
    found = re.search(rf"^{name}\n-+\n(.*?)(?=^\w[\w ]*\n-{{3,}}\n|\Z)", doc, re.DOTALL | re.MULTILINE)
    return found[1] if found else ""


def faults(function: Callable[..., Any]) -> list[str]:
    """Parts that are missing in the docstring of a function."""
    doc = inspect.getdoc(function) or ""
    if not doc:
        return ["no docstring"]
    signature = inspect.signature(function)
    expected = [name for name in signature.parameters if name not in ("self", "cls")]
    entries = [line for line in section(doc, "Parameters").splitlines() if line[:1].strip()]
    named = {word.strip() for line in entries for word in line.split(" : ")[0].split(",")}
    wrong = [f"parameter {name}" for name in expected if name not in named]
    gives = str(signature.return_annotation) not in ("None", str(inspect.Signature.empty))
    # without parameters the summary says what comes back
    if expected and gives and not section(doc, "Returns"):
        wrong.append("what it returns")
    return wrong


def name_of(function: Callable[..., Any]) -> str:
    return f"{function.__module__}.{function.__qualname__}"


@pytest.mark.parametrize("package", PACKAGES)
def test_docstrings_name_every_parameter_and_every_result(package: str) -> None:
    wrong = {
        name_of(f): faults(f) for f in public(package) if f.__module__.startswith("surffollow") and faults(f)
    }
    assert wrong == {}
