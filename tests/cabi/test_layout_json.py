"""The JSON of `surffollow print-header --json` says the same as C header and programs."""

from __future__ import annotations

import inspect
import json
import subprocess
from pathlib import Path
from typing import Any

from click.testing import CliRunner

from cabi.running import ROOT
from surffollow.cli.main import cli
from surffollow.client import attachment, client, observer, reclaim, refusal, requests, slot, slot_request
from surffollow.service import daemon, slot_server
from surffollow.shm import cheader
from surffollow.shm import layout_board as lb
from surffollow.shm import layout_json as lj

EXACT = 1 << 53  # whole numbers up to here survive every JSON reader


def printed() -> dict[str, Any]:
    return dict(json.loads(CliRunner().invoke(cli, ["print-header", "--json"]).output))


def test_a_c_compiler_agrees_with_every_offset_and_number(tmp_path: Path) -> None:
    layout = printed()
    facts = []
    for name, shape in layout["structs"].items():
        facts.append(f"sizeof({name}) == {shape['bytes']}")
        for f in shape["fields"]:
            member = f"(({name} *)0)->{f['name']}"
            facts.append(
                f"offsetof({name}, {f['name']}) == {f['offset']} && sizeof({member}) == {f['bytes']}"
            )
    enums = layout["enums"]
    for key in ("request", "board_state", "access", "slot_step"):
        facts += [f"SF_{name} == {number}" for name, number in enums[key].items()]
    facts += [f"SF_{n} == {v}" for n, v in enums["slot_result"].items() if v]
    facts += [f"SF_RQ_{r['name']} == {r['code']}" for r in layout["requests"]]
    facts += [f"SF_ANSWER_{a['name']} == {a['result']}" for a in layout["answers"]]
    facts += [f"SF_{n} == 1 << {k}" for n, k in layout["bits"]["sf_output.status"].items()]
    facts += [f"SF_STOP_{n.upper()} == 1 << {k}" for n, k in layout["bits"]["sf_output.stop"].items()]
    facts += [
        f"SF_LAYOUT_HASH == UINT64_C({layout['hash']})",
        f"SF_LAYOUT_VERSION == {layout['version']}",
    ]
    for key, name in (("board", "BOARD"), ("map", "MAP"), ("world", "WORLD")):
        facts.append(f"(uint64_t)SF_{name}_MAGIC == UINT64_C({layout['objects'][key]['magic']['value']})")
    facts.append(f"(uint64_t)SF_SLOT_MAGIC == UINT64_C({layout['handshake']['magic']['value']})")
    parts = {p["name"]: p["offset"] for p in layout["objects"]["slot"]["parts"]}
    facts += [f"SF_SLOT_{n.upper()} == {parts[n]}" for n in ("head", "pose", "request", "ranges")]
    ring = next(p for p in layout["objects"]["slot"]["parts"] if p["name"] == "ranges")
    facts += [f"SF_RANGE_ITEMS == {ring['items']}", f"SF_RANGES_AT == {ring['items_at']}"]
    facts.append(f"SF_SLOT_STREAM + SF_PIECE_BYTES == {parts['stream1']}")
    source = tmp_path / "facts.c"
    lines = "\n".join(f'_Static_assert({fact}, "");' for fact in facts)
    source.write_text(f'#include "surffollow.h"\n{lines}\n')
    command = ["gcc", "-std=c11", "-fsyntax-only", f"-I{ROOT / 'include'}", str(source)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(facts) > 350


def test_every_request_and_answer_is_reported() -> None:
    layout = printed()
    codes = {r["code"] for r in layout["requests"]}
    assert codes == set(layout["enums"]["request"].values()) - {lb.RQ_NONE}
    known = {a["result"] for a in layout["answers"]}
    used = {a["result"] for r in layout["requests"] for a in (*r["acks"], *r["map_acks"])}
    assert known - used == {lb.ERR_UNKNOWN_REQUEST}, "the answer to what is no request"


def test_no_number_is_too_large_for_a_reader_with_doubles() -> None:
    def numbers(value: Any) -> list[float]:
        if isinstance(value, dict | list):
            items = value.values() if isinstance(value, dict) else value
            return [n for item in items for n in numbers(item)]
        return [value] if isinstance(value, int | float) else []

    whole = [n for n in numbers(printed()) if n == int(n)]
    assert max(map(abs, whole)) <= EXACT
    assert len(whole) > 1000


def test_waits_and_limits_are_those_of_service_and_client() -> None:
    options = inspect.signature(observer.Observer).parameters
    assert options["stale_periods"].default == lj.STALE_PERIODS
    assert round(1e9 * options["stale_min_s"].default) == lj.STALE_MIN_NS
    for ours, theirs in (
        (cheader.EXCHANGE_NS, slot_server.EXCHANGE_S),
        (cheader.EXCHANGE_NS, slot.EXCHANGE_S),
        (cheader.EXCHANGE_NS, client.CLAIM_ANSWER_S),
        (cheader.SLOT_WAIT_NS, slot.ATTACH_S),
        (lj.FULL_NS, slot_server.FULL_S),
        (lj.HEARTBEAT_NS, daemon.HOUSEKEEPING_S),
        (lj.CONNECT_AGAIN_NS, slot_request._AGAIN_S),
        (lj.CLAIM_NS, reclaim.CLAIM_RETRY_S),
        (lj.CLAIM_AGAIN_NS, refusal.FIRST_PAUSE_NS / 1e9),
        (cheader.REFUSED_NS, refusal.REFUSED_NS / 1e9),
        (cheader.STALE_MAX_NS, attachment.STALE_MAX_NS / 1e9),
        (cheader.STALE_LONGEST_NS, attachment.LONGEST_STALE_S),
        (1e9 * cheader.STALE_LEAST_PERIODS, attachment.STALE_LEAST_PERIODS),
        (lj.REQUEST_LOST_NS, requests.LOST_S),
    ):
        assert ours == round(1e9 * theirs)
