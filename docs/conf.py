"""Sphinx configuration of the site that `make docs` builds (docs/decisions/0011)."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path
from typing import Any

from sphinx.util import logging

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
sys.path.insert(0, str(ROOT / "src"))

project = "surffollow"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = "index"
exclude_patterns = ["conf.py"]
html_theme = "furo"
html_title = "surffollow"
html_copy_source = False
html_show_sphinx = False
default_role = "code"
myst_heading_anchors = 4
myst_enable_extensions = ["deflist"]
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
napoleon_preprocess_types = False
suppress_warnings = ["misc.highlighting_failure"]

LINK = re.compile(r"(?<!!)\[((?:[^\[\]]|\[[^\]]*\])+)\]\(([^)\s]+)\)")
API = re.compile(r"^<!-- api: ([\w.]+) -->$", re.MULTILINE)


def toctrees() -> str:
    """The tables of contents, from the headings and lists of docs/index.md."""
    trees: dict[str, list[str]] = {}
    heading = ""
    for line in (DOCS / "index.md").read_text(encoding="utf-8").splitlines():
        if found := re.match(r"#{2,3} (.*)", line):
            heading = found[1]
        elif found := re.fullmatch(r"- \[.+\]\((\S+)\.md\)", line):
            trees.setdefault(heading, []).append(found[1])
    return "".join(
        "\n".join(["", "```{toctree}", ":hidden:", f":caption: {heading}", "", *pages, "```", ""])
        for heading, pages in trees.items()
    )


def public(package: str) -> str:
    """Directives for everything in a module's `__all__`, or for the module as a whole."""
    module = importlib.import_module(package)
    lines: list[str] = []
    names = getattr(module, "__all__", None)
    if names is None:
        own = [n for n, v in vars(module).items() if getattr(v, "__module__", "") == package]
        names = [n for n in own if not n.startswith("_")]
    for name in sorted(names, key=str.lower):
        thing = getattr(module, name)
        if isinstance(thing, type):
            lines += [f".. autoclass:: {package}.{name}", "   :members:", "   :show-inheritance:"]
            lines += ["   :inherited-members: tuple,dict,Exception,BaseException", ""]
        elif callable(thing):
            lines += [f".. autofunction:: {package}.{name}", ""]
        else:
            lines += [f".. py:data:: {package}.{name}", f"   :value: {thing!r}", ""]
    return "```{eval-rst}\n" + "\n".join(lines) + "\n```"


def read_source(app: Any, name: str, text: list[str]) -> None:
    """Expand the pages of the Python interface; show links that leave docs/ as their text."""
    here = DOCS / f"{name}.md"

    def outside(found: re.Match[str]) -> str:
        target = found[2].partition("#")[0]
        if not target or ":" in target:
            return found[0]
        path = (here.parent / target).resolve()
        if path.is_relative_to(DOCS) and path.is_file():
            return found[0]
        if not path.exists() or (path.is_relative_to(DOCS) and not path.is_dir()):
            logging.getLogger(__name__).warning("%s.md links to %s, which is not there", name, target)
            return found[0]
        words, where = found[1].strip("`"), path.relative_to(ROOT).as_posix()
        return f"`{words}`" if words in where else f"{found[1]} (`{where}`)"

    text[0] = API.sub(lambda found: public(found[1]), LINK.sub(outside, text[0]))
    if name == root_doc:
        text[0] += toctrees()


def literal(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Make single backticks and plain asterisks of docstrings safe for reStructuredText, but in examples."""
    out, example = [], False
    for line in lines:
        example = line.lstrip().startswith(">>> ") or (example and bool(line.strip()))
        if example:
            out.append(line)
            continue
        line = re.sub(r"(?<![`\w])`([^`]+)`(?!`)", r"``\1``", line)
        parts = re.split(r"(``.*?``)", line)
        out.append("".join(p if p.startswith("``") else re.sub(r"([*|])", r"\\\1", p) for p in parts))
    lines[:] = out


def setup(app: Any) -> None:
    app.connect("source-read", read_source)
    app.connect("autodoc-process-docstring", literal, priority=100)
