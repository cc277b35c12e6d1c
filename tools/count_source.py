"""Count lines of code, named constants and other numbers of the follower, per stage.

A line of code holds something besides comments, docstrings and blanks. A named constant is an upper-case name
that a module assigns; names that several modules share count once. Other numbers are those written in
functions: each is a constant without a name, but for 0.5, the numbers of coordinates and
of a pose, and powers of ten.

    python tools/count_source.py [--json] [PACKAGE]
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import math
import tokenize
from collections.abc import Sequence
from pathlib import Path

SOURCE = Path(__file__).resolve().parent.parent / "src/surffollow"
SILENT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}
STRUCTURAL = {0, 0.5, 1, 2, 3, 7}  # halves, sums, squares, coordinates and numbers of a pose
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef)


def docstring_lines(tree: ast.Module) -> set[int]:
    """Numbers of the lines of all docstrings, those of constants included."""
    found: set[int] = set()
    for node in ast.walk(tree):
        for statement in node.body if isinstance(node, DOCUMENTED) else []:
            value = getattr(statement, "value", None)
            text = isinstance(value, ast.Constant) and isinstance(value.value, str)
            if isinstance(statement, ast.Expr) and text:
                found.update(range(statement.lineno, (statement.end_lineno or statement.lineno) + 1))
    return found


def count_lines(source: str) -> int:
    """Lines of code of a module."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in SILENT:
            lines.update(range(token.start[0], token.end[0] + 1))
    return len(lines - docstring_lines(ast.parse(source)))


def constants(source: str) -> set[str]:
    """Upper-case names that a module assigns."""
    found: set[str] = set()
    for node in ast.parse(source).body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        for name in (n for t in targets if t is not None for n in ast.walk(t)):
            if not isinstance(name, ast.Name) or not isinstance(name.ctx, ast.Store):
                continue  # an index of what is assigned
            if name.id == name.id.upper() and name.id.strip("_"):
                found.add(name.id)
    return found


def unnamed_numbers(source: str) -> int:
    """Numbers written in functions that are neither structural nor factors of units."""
    functions = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef)]
    found = {n for f in functions for n in ast.walk(f) if isinstance(n, ast.Constant)}
    values = [n.value for n in found if isinstance(n.value, int | float) and not isinstance(n.value, bool)]
    return sum(abs(v) not in STRUCTURAL and not math.log10(abs(v)).is_integer() for v in values)


def count(package: Path) -> dict[str, dict[str, int]]:
    """Modules, lines of code and constants per folder of a package, and of all of it."""
    stages: dict[str, dict[str, int]] = {}
    names: dict[str, set[str]] = {}
    for path in sorted(package.rglob("*.py")):
        source = path.read_text()
        for stage in (str(path.parent.relative_to(package)), "all"):
            row = stages.setdefault(stage, {"modules": 0, "lines": 0, "constants": 0, "numbers": 0})
            row["modules"] += 1
            row["lines"] += count_lines(source)
            row["numbers"] += unnamed_numbers(source)
            names.setdefault(stage, set()).update(constants(source))
            row["constants"] = len(names[stage])
    stages["all"] = stages.pop("all")
    return stages


def main(argv: Sequence[str] | None = None) -> int:
    """Print the counts of a package."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("package", nargs="?", default="forecast", help="folder of src/surffollow [forecast]")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    if not (SOURCE / args.package).is_dir():
        parser.error(f"no package '{args.package}' in {SOURCE.name}")
    stages = count(SOURCE / args.package)
    if args.json:
        print(json.dumps(stages, indent=1))
        return 0
    print(f"{'stage':<12} modules  lines  constants  numbers")
    for stage, row in stages.items():
        print(f"{stage:<12} {row['modules']:>7} {row['lines']:>6} {row['constants']:>10} {row['numbers']:>8}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
