"""Write the C header: layouts, constants and parameters from their declarations, functions from parts.

`python -m surffollow.shm.cheader` rewrites the committed file, with `--check` only compares;
`surffollow print-header` prints it.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from surffollow.config.params import PARAMS, UNIT_ENDINGS
from surffollow.config.pose_limits import MAX_POSITION_M
from surffollow.config.stop_causes import STOP_NAMES
from surffollow.errors import SchemaError
from surffollow.shm import board_regions, latch_shape, layout_follow
from surffollow.shm import layout_board as lb
from surffollow.shm import layout_slot as ls
from surffollow.shm import map_layout as ml
from surffollow.shm import world_block as wb
from surffollow.shm.layout_follow import Output, Params
from surffollow.shm.schema import SCALARS, Field, Schema

PARTS = Path(__file__).with_name("header")
HEADER = Path(__file__).parents[1] / "include" / "surffollow.h"
SCHEMAS: tuple[type[Schema], ...] = (
    lb.Region,
    lb.BoardHeader,
    Params,
    Output,
    lb.Ack,
    lb.MainThreadState,
    lb.MapStatus,
    lb.Stats,
    lb.AuditEntry,
    lb.LogHead,
    ls.SlotMessage,
    lb.ClientInfo,
    ls.SlotHead,
    ls.PosePost,
    ls.RangeItem,
    ls.RequestPost,
    ls.StreamPiece,
    ml.MapHeader,
    ml.GridPair,
    wb.WorldHeader,
    wb.WorldPose,
)
_SLOT_WORDS = (
    *("SLOT_ASK", "SLOT_OFFER", "SLOT_MAPPED", "SLOT_GRANT", "SLOT_REFUSE"),
    *("SLOT_ALL_TAKEN", "SLOT_USER_LIMIT", "SLOT_PROCESS_LIMIT", "SLOT_OTHER_RUN", "SLOT_BAD_MESSAGE"),
)
# rules of the client library, the same in Python (a test compares)
STALE = 1 << 16
REATTACH_EVERY_NS = 20_000_000
LOOK_EVERY_NS = 100_000_000
# a demand is stale after the configured number of periods, but after this time at the latest: a period of
# 1 s would keep the demand of a dead service for 20 s; it lives for some periods in any case
STALE_MAX_NS = 100_000_000
STALE_LEAST_PERIODS = 3
STALE_LONGEST_NS = 86_400_000_000_000  # that a client may choose: beyond, old demands stay valid for ever
REFUSED_NS = 1_000_000_000  # between two requests of a control loop for what another client holds
SLOT_WAIT_NS = 3_000_000_000  # for attach to get a slot
EXCHANGE_NS = 1_000_000_000  # for one exchange, or the answer to a claim of the pose; then it is begun anew
POSE_FUTURE_NS = 1_000_000
RANGE_FUTURE_NS = 1_000_000
RANGE_OLDEST_NS = 1_000_000_000  # older ones mean nothing to a follower


def c_name(schema: type[Schema], prefix: str = "sf_") -> str:
    """C name of a schema's structure: `MapHeader` → `sf_map_header`."""
    return prefix + re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", schema.__name__).lower()


def _member(f: Field, prefix: str, text_note: str) -> str:
    if f.nested is not None:
        kind = c_name(f.nested, prefix)
    else:
        kind = "char" if f.is_text else SCALARS[f.code][2]
    natural = f.nested.ALIGN if f.nested is not None else f.item_size
    align = f"SF_ALIGNAS({f.extra_align}) " if f.extra_align > natural else ""
    count = f"[{f.count}]" if f.count > 1 or f.is_text else ""
    doc = "; ".join(x for x in (_ascii(f.doc), text_note if f.is_text else "") if x)
    note = " ".join(x for x in (f"[{_ascii(f.unit)}]" if f.unit else "", doc) if x)
    return f"  {align}{kind} {f.name}{count};" + (f" /* {note} */" if note else "")


def _ascii(text: str) -> str:
    for this, that in (("…", "..."), ("·", "*"), ("→", "->"), ("²", "^2"), ("Φ", "phi"), ("×", "x")):
        text = text.replace(this, that)
    printable = "".join(c if c.isprintable() else " " for c in text)
    return printable.encode("ascii", "replace").decode().replace("*/", "* /").replace("/*", "/ *")


def c_struct(schema: type[Schema], prefix: str = "sf_", text_note: str = "") -> str:
    """A schema as a C structure, with an assertion for its size, its alignment and every offset.

    Parameters
    ----------
    schema : type[Schema]   nested schemas must have been written before
    prefix : str            of the structure's name
    text_note : str         in the comments of its text members

    Returns
    -------
    str  C11 and C++17 text; needs SF_ALIGNAS and SF_STATIC_ASSERT
    """
    name = c_name(schema, prefix)
    text = "layout of " + name
    lines = [f"/* {_ascii((schema.__doc__ or '').strip().splitlines()[0])} */"] if schema.__doc__ else []
    lines += [
        f"typedef struct {name} {{",
        *(_member(f, prefix, text_note) for f in schema.FIELDS),
        f"}} {name};",
    ]
    lines.append(f'SF_STATIC_ASSERT(sizeof({name}) == {schema.SIZE}, "{text}");')
    lines += [f'SF_STATIC_ASSERT(offsetof({name}, {f.name}) == {f.offset}, "{text}");' for f in schema.FIELDS]
    return "\n".join(lines) + "\n"


def _enum(pairs: Iterable[tuple[str, int]]) -> str:
    return "enum {\n" + ",\n".join(f"  SF_{n} = {v}" for n, v in pairs) + "\n};\n"


def _defines() -> Iterator[tuple[str, str]]:
    def word(n: int) -> str:
        return f"INT64_C({n})"

    yield "LAYOUT_VERSION", f"{lb.LAYOUT_VERSION}u"
    yield "LAYOUT_HASH", f"UINT64_C({board_regions.layout_hash()})"
    yield "BOARD_MAGIC", word(lb.BOARD_MAGIC)
    yield "SLOT_MAGIC", f"UINT64_C({ls.SLOT_MAGIC})"
    yield "MAP_MAGIC", f"UINT64_C({ml.MAGIC})"
    yield "MAP_LAYOUT_HASH", f"UINT64_C({ml.LAYOUT_HASH})"
    yield "WORLD_MAGIC", word(wb.MAGIC)
    yield "WORLD_LAYOUT_HASH", f"UINT64_C({wb.WorldPose.HASH})"
    yield "WORLD_BYTES", str(wb.SIZE)
    yield "CLIENTS", str(lb.CLIENTS)
    yield "PAGE", str(lb.PAGE)
    for name in (
        *("REQUEST_ARGS", "SLOT_BYTES", "SLOT_HEAD", "SLOT_POSE", "SLOT_REQUEST", "STOP_WORD"),
        *("SLOT_RANGES", "RANGES_AT", "RANGE_ITEMS"),
        *("SLOT_STREAM", "PIECE_BYTES", "PIECE_GRIDS", "PIECE_HEIGHTS", "PIECE_COUNTS", "STOP_TEXT_WORDS"),
    ):
        yield name, str(getattr(ls, name))
    for name in ("AUDIT_WORDS", "AUDIT_ENTRY_WORDS", "AUDIT_ENTRIES"):
        yield name, str(getattr(lb, name))
    yield "REGIONS", str(lb.BoardHeader.field("region").count)
    yield "CHANNELS", str(layout_follow.CHANNELS)
    yield "LATCH_SLOTS", str(latch_shape.SLOTS)
    yield "LATCH_HEAD_BYTES", str(latch_shape.HEAD_BYTES)
    yield "LATCH_MAX_TRIES", str(latch_shape.MAX_TRIES)
    yield "MAP_HEADER_BYTES", str(ml.HEADER_BYTES)
    yield "MAP_UNKNOWN_HEIGHT", f"({ml.UNKNOWN})"
    yield "MAX_REGION_M", str(ml.MAX_REGION_M)
    yield "MIN_GRID_M", str(ml.MIN_GRID_M)
    yield "MAX_GRID_M", str(ml.MAX_GRID_M)
    yield "REATTACH_EVERY_NS", str(REATTACH_EVERY_NS)
    yield "LOOK_EVERY_NS", str(LOOK_EVERY_NS)
    yield "STALE_MAX_NS", str(STALE_MAX_NS)
    yield "STALE_LEAST_PERIODS", str(STALE_LEAST_PERIODS)
    yield "STALE_LONGEST_NS", str(STALE_LONGEST_NS)
    yield "REFUSED_NS", str(REFUSED_NS)
    yield "SLOT_WAIT_NS", str(SLOT_WAIT_NS)
    yield "EXCHANGE_NS", str(EXCHANGE_NS)
    yield "POSE_FUTURE_NS", str(POSE_FUTURE_NS)
    yield "RANGE_FUTURE_NS", str(RANGE_FUTURE_NS)
    yield "RANGE_OLDEST_NS", str(RANGE_OLDEST_NS)
    yield "MAX_POSITION_M", str(MAX_POSITION_M)


def _answers() -> str:
    answers = [("OK", lb.OK), ("ACCEPTED", lb.ACCEPTED), *lb.codes("ERR_").items()]
    answers.sort(key=lambda pair: pair[1])
    if [v for _, v in answers] != list(range(len(lb.RESULT_TEXT))):
        raise SchemaError("every answer of the service needs one text in RESULT_TEXT")
    refused = [(n.replace("ERR_", "REFUSED_"), -100 - v) for n, v in answers if n.startswith("ERR_")]
    cases = "\n".join(
        f'    case {v}: return "{_ascii(text).replace(chr(34), chr(39))}";'
        for v, text in enumerate(lb.RESULT_TEXT)
    )
    return (
        "/* what the service answers, and the results that its refusals become */\n"
        + _enum((f"ANSWER_{n}", v) for n, v in answers)
        + f"#define SF_ANSWERS {len(answers)}\n"
        + _enum(refused)
        + "\n/* An answer of the service in words; never NULL. */\n"
        + "static inline const char *sf_answer_text(int answer) {\n  switch (answer) {\n"
        + cases
        + '\n    default: return "unknown result";\n  }\n}\n'
    )


def _param_table() -> str:
    rows = []
    for name, spec in PARAMS.items():
        whole = int(Params.field(name).code == "i8")
        number = Params.offset(name) // 8
        rows.append(f'    {{"{name}", {number}, {whole}, {float(spec.low)!r}, {float(spec.high)!r}}},')
    return (
        "/* A parameter that may be set: its number in requests, whether it is whole, its bounds. */\n"
        "typedef struct sf_param_info {\n  const char *name;\n  int64_t number;\n  int whole;\n"
        "  double low, high;\n} sf_param_info;\n\n"
        f"#define SF_PARAMS {len(PARAMS)}\n"
        f"#define SF_PARAM_ENDINGS {', '.join(f'{chr(34)}{e}{chr(34)}' for e in UNIT_ENDINGS)}\n"
        "static inline const sf_param_info *sf_param_table(void) {\n"
        "  static const sf_param_info table[SF_PARAMS] = {\n"
        + "\n".join(rows)
        + "\n  };\n  return table;\n}\n"
    )


def _status_bits() -> str:
    bits = [(n, 1 << k) for k, n in enumerate(layout_follow.STATUS_NAMES)]
    cases = "\n".join(f'    case {v}: return "{n}";' for n, v in [*bits, ("STALE", STALE)])
    return (
        "/* bits of a demand's status; STALE is set by the client: the service is silent, dead or gone */\n"
        + _enum([*bits, ("STALE", STALE)])
        + "\n/* The name of one status bit; never NULL. */\n"
        + "static inline const char *sf_status_name(int64_t bit) {\n  switch (bit) {\n"
        + cases
        + '\n    default: return "?";\n  }\n}\n'
    )


def layout_text() -> str:
    """The generated part of the header: constants, structures, assertions, parameter table."""
    map_states = [(f"MAP_{n.upper()}", k) for k, n in enumerate(ml.STATE_NAMES)]
    map_states[0] = ("MAP_NO_MAP", 0)
    rounding = [(f"MAP_ROUND_{n.upper()}", k) for k, n in enumerate(ml.ROUNDING_NAMES)]
    pieces = [
        "/* ---- layout: generated ------------------------------------------------------------ */\n",
        "".join(f"#define SF_{n} {v}\n" for n, v in _defines()),
        _enum(lb.codes("RQ_").items()),
        _enum(lb.codes("STATE_").items()),
        _enum(lb.codes("ACCESS_").items()),
        _enum((n, int(getattr(ls, n))) for n in _SLOT_WORDS),
        _enum(map_states),
        _enum(rounding),
        _answers(),
        _status_bits(),
        "/* causes of a latched stop: bits of sf_output's `stop` */\n"
        + _enum((f"STOP_{n.upper()}", 1 << k) for k, n in enumerate(STOP_NAMES)),
        _param_table(),
        *(c_struct(s) for s in SCHEMAS),
    ]
    return "\n".join(pieces)


def header_text() -> str:
    """The whole header; needs the source tree, for the parts are not installed."""
    parts = sorted(PARTS.glob("*.h"))
    first, rest = parts[0], parts[1:]
    return "".join([first.read_text(), layout_text() + "\n", *(p.read_text() for p in rest)])


if __name__ == "__main__":
    if "--check" in sys.argv[1:]:
        sys.exit(0 if header_text() == HEADER.read_text() else f"{HEADER.name} is out of date")
    HEADER.write_text(header_text())
    print(f"wrote {HEADER.name}: {HEADER.stat().st_size} bytes")
