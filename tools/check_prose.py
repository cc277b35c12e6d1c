"""Check the prose of the documents: length of sentences, of table cells, and words that have a better term.

`python tools/check_prose.py [PAGE…]`; without pages README.md, ARCHITECTURE.md and docs/.
`--list` also prints the longest sentences. Code blocks, code spans, equations and link targets are no prose.

- The sentences of a page have at most 20 words on average, and none has more than 40.
- A table cell has at most 25 words.
- No sentence has "what" or "who" for its subject, and the words of the list below are not used.
  Decisions record history and are exempt from this rule. So are parts that other tools generate.
- No heading of a page and no docstring of a module, class or function begins with "what", "who" or "nobody".
  `src/surffollow/forecast` and `tests/forecast` are not checked yet.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
MEAN_WORDS = 20.0
SENTENCE_WORDS = 40
CELL_WORDS = 25

# a pattern, and what to write instead
INSTEAD = {
    r"lucky?": "complexity penalty, chance",
    r"scouts?|scouted": "look-ahead sensor",
    r"beats?": "housekeeping period (of the main thread); exceeds",
    r"contests?": "benchmark",
    r"bars?": "acceptance criterion, limit",
    r"doors?": "interface",
    r"ticks?": "controller period",
    r"stamps?|stamped": "timestamp",
    r"tells?|told": "reports, states",
    r"heeds?|heeded": "follows, uses",
    r"believes?|believed|beliefs?": "confirmed; posterior",
    r"judges?|judged": "evaluated, scored",
    r"guess(?:es|ed)?": "estimate, prediction",
    r"news": "sample, measurement",
    r"quarantined?": "pending",
    r"doubts?|doubted": "pending, uncertain",
    r"calm(?:er|est|s|ed)?": "smooth, low acceleration",
    r"restless(?:ness)?": "acceleration, effort penalty",
    r"caution": "variance penalty",
    r"glid(?:e|es|ed|ing)": "setpoint filter, deadband",
    r"young": "burn-in",
    r"wanted": "desired, setpoint",
    r"set[ -]points?": "setpoint",
    r"inbox": "slot",
    r"(?:has|have|had) a say|loses? its say": "weight",
    r"way ahead": "lookahead",
    r"hears?|heard": "received",
    r"by hand": "manually",
    r"(?:no|some|any|every)body|whoever": "no client, a user, another process, all users",
}
WORDS = {re.compile(rf"\b(?:{pattern})\b", re.IGNORECASE): better for pattern, better in INSTEAD.items()}
SUBJECT = re.compile(r"\W*(?:What|Who|Whoever|Whatever|Whose)\b")
GENERATED = re.compile(r"<!-- ([\w ]+): written by .*? -->.*?<!-- end of \1 -->", re.DOTALL)
WHOLE = ("docs/reference/cli.md", "docs/reference/c-api.md")
OPENING = re.compile(r"\W*(?:What|Who|Whoever|Whatever|Whose|Nobody|Somebody|Anybody|Everybody)\b")
END = re.compile(r"(?<=[.!?])[\"')*_]*\s+(?=[\"'(*_]*[A-ZΑ-ΩŠ0-9`\d])")


def pages() -> list[Path]:
    """All pages of prose, the longest-lived ones first."""
    return [ROOT / "README.md", ROOT / "ARCHITECTURE.md", *sorted((ROOT / "docs").rglob("*.md"))]


def plain(text: str) -> str:
    """Text without code spans, pictures, link targets, comments and emphasis."""
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)", "", text)
    text = re.sub(r"\]\([^)]*\)", "]", text)
    text = re.sub(r"``.+?``|`[^`]*`", "Code", text, flags=re.DOTALL)
    return text.replace("[", "").replace("]", "").replace("**", "")


def blocks(text: str) -> Iterator[tuple[str, str]]:
    """Paragraphs and list items ("text"), and cells of tables ("cell"), in order."""
    text = re.sub(r"^([ ]*)```.*?^\1```", "", text, flags=re.DOTALL | re.MULTILINE)
    paragraph: list[str] = []

    def done() -> Iterator[tuple[str, str]]:
        if paragraph:
            yield "text", " ".join(paragraph)
            paragraph.clear()

    after_blank = True
    for line in text.splitlines():
        if re.match(r"( {4,}|\t)", line) and after_blank and not paragraph:
            continue  # an equation, or code
        if line.lstrip().startswith("|"):
            yield from done()
            if not re.fullmatch(r"[|:\- ]+", line.strip()):
                row = re.sub(r"`[^`]*`", lambda m: m[0].replace("|", "/"), line.strip())
                for cell in re.split(r"(?<!\\)\|", row)[1:-1]:
                    yield "cell", cell.strip()
        elif not line.strip() or line.startswith("#"):
            yield from done()
        elif re.match(r"\s*(?:[-*]|\d+\.) ", line):
            yield from done()
            paragraph.append(re.sub(r"^\s*(?:[-*]|\d+\.) ", "", line))
        else:
            paragraph.append(line.strip())
        after_blank = not line.strip() or (after_blank and line.startswith("    "))
    yield from done()


def count(text: str) -> int:
    """Words: runs that hold a letter or digit."""
    return sum(1 for word in text.split() if re.search(r"\w", word))


def sentences(text: str) -> list[str]:
    """Sentences of a paragraph."""
    return [s for s in END.split(text) if count(s) > 0]


def faults(path: Path, show: bool) -> Iterator[str]:
    """Findings of a page."""
    name = path.relative_to(ROOT).as_posix()
    text = path.read_text(encoding="utf-8")
    own = "" if name in WHOLE else GENERATED.sub("", text)
    spoken = [s for kind, block in blocks(own) if kind == "text" for s in sentences(plain(block))]
    if spoken:
        mean = sum(map(count, spoken)) / len(spoken)
        if mean > MEAN_WORDS:
            yield f"{name}: sentences have {mean:.1f} words on average, more than {MEAN_WORDS:.0f}"
        for s in spoken:
            if count(s) > SENTENCE_WORDS:
                yield f"{name}: a sentence of {count(s)} words: {s[:70]}…"
        if show:
            for s in sorted(spoken, key=count, reverse=True)[:8]:
                yield f"    {count(s)}: {s}"
    for title in re.findall(r"^#+ (.*)", text, re.MULTILINE):
        if OPENING.match(title) and not title.endswith("?"):
            yield f"{name}: the heading is a question: {title}"
    for kind, block in blocks(text):
        if kind == "cell" and count(plain(block)) > CELL_WORDS:
            yield f"{name}: a cell of {count(plain(block))} words: {plain(block)[:70]}…"
    if name.startswith("docs/decisions/"):
        return
    for s in spoken:
        if SUBJECT.match(s) and not s.endswith("?"):
            yield f"{name}: the subject is a question: {s[:70]}…"
    for _, block in blocks(own):
        for pattern, better in WORDS.items():
            for found in pattern.finditer(plain(block)):
                near = plain(block)[max(0, found.start() - 30) : found.end() + 20]
                yield f"{name}: “{found[0]}” (… {near} …); write: {better}"


def docstring_faults() -> Iterator[str]:
    """Docstrings of modules, classes and functions that begin with a question word."""
    for folder in ("src", "tests", "tools", "examples"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            name = path.relative_to(ROOT).as_posix()
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                    said = ast.get_docstring(node) or ""
                    if OPENING.match(said):
                        at = 1 if isinstance(node, ast.Module) else node.lineno
                        yield f"{name}:{at}: the docstring has no subject: {said.splitlines()[0]}"


if __name__ == "__main__":
    named = [Path(a).resolve() for a in sys.argv[1:] if not a.startswith("-")]
    said = [fault for path in named or pages() for fault in faults(path, "--list" in sys.argv[1:])]
    said += [] if named else docstring_faults()
    for fault in said:
        print(fault)
    sys.exit(any(not fault.startswith("    ") for fault in said))
