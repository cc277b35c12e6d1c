"""Write Rust constants from the layout's JSON: `python generate.py layout.rs`; no surffollow is imported.

The JSON is what `surffollow print-header --json` prints, or the file that SURFFOLLOW_LAYOUT names.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any


def layout() -> dict[str, Any]:
    named = os.environ.get("SURFFOLLOW_LAYOUT")
    if named:
        return dict(json.loads(Path(named).read_text(encoding="utf-8")))
    command = [sys.executable, "-m", "surffollow", "print-header", "--json"]
    return dict(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))


def module(name: str, lines: list[str]) -> str:
    return f"pub mod {name} {{\n" + "".join(f"    {line}\n" for line in lines) + "}\n"


def rust(reported: dict[str, Any]) -> str:
    """All that the client needs, with the names of the JSON."""
    slot = {p["name"]: p for p in reported["objects"]["slot"]["parts"]}
    latch = reported["latch"]
    board = reported["objects"]["board"]
    text = [
        "// Written by generate.py from `surffollow print-header --json`; not for editing.\n",
        f"pub const RELEASE: &str = {json.dumps(reported['release'])};\n",
        f"pub const LAYOUT_VERSION: u32 = {reported['version']};\n",
        f"pub const LAYOUT_HASH: u64 = {reported['hash']};\n",
        f"pub const BOARD_MAGIC: u64 = {board['magic']['value']};\n",
        f"pub const SLOT_MAGIC: u64 = {reported['handshake']['magic']['value']};\n",
        f"pub const SLOT_SEALS: i32 = {reported['handshake']['seals']};\n",
        f"pub const SLOT_BYTES: usize = {reported['objects']['slot']['bytes']};\n",
        *(f"pub const SLOT_{n.upper()}: usize = {p['offset']};\n" for n, p in slot.items()),
        *(f"pub const LATCH_{k.upper()}: i64 = {latch[k]};\n" for k in ("copies", "copies_at", "max_tries")),
        f"pub const LATCH_WHOLE_WHILE_GROWN_BY: u64 = {latch['whole_while_grown_by']};\n",
    ]
    for name, shape in reported["structs"].items():
        lines = [f"pub const BYTES: usize = {shape['bytes']};"]
        lines += [f"pub const {f['name'].upper()}: usize = {f['offset']};" for f in shape["fields"]]
        text.append(module(name, lines))
    strides = {p["name"]: p["stride"] for p in board["parts"] if "stride" in p}
    text.append(module("stride", [f"pub const {n.upper()}: usize = {v};" for n, v in strides.items()]))
    codes = [f"pub const {r['name']}: i64 = {r['code']};" for r in reported["requests"]]
    text.append(module("request", codes))
    answers = [f"pub const {a['name']}: i64 = {a['result']};" for a in reported["answers"]]
    text.append(module("answer", answers))
    status = [f"pub const {n}: i64 = 1 << {k};" for n, k in reported["bits"]["sf_output.status"].items()]
    text.append(module("status", status))
    steps = [f"pub const {m['name']}: i64 = {m['step']};" for m in reported["handshake"]["messages"]]
    text.append(module("step", sorted(set(steps))))
    states = reported["enums"]["board_state"]
    text.append(
        module("state", [f"pub const {n.removeprefix('STATE_')}: i64 = {v};" for n, v in states.items()])
    )
    waits = [f"pub const {n.upper()}: i64 = {v};" for n, v in reported["waits"].items()]
    text.append(module("wait", waits))
    for name, key in (("answer_text", "answers"), ("refusal_text", "slot_refusals")):
        arms = "".join(f"        {a['result']} => {json.dumps(a['text'])},\n" for a in reported[key])
        text.append(
            f"pub fn {name}(result: i64) -> &'static str {{\n    match result {{\n{arms}"
            '        _ => "unknown result",\n    }\n}\n'
        )
    return "".join(text)


def main() -> int:
    if len(sys.argv) != 2:
        print(__doc__, file=sys.stderr)
        return 2
    Path(sys.argv[1]).write_text(rust(layout()), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
