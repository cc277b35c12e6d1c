"""Tables of the layout document: numbers of states, bits, requests with their answers, parameters."""

from __future__ import annotations

from typing import Any

from surffollow.config.params import PARAMS
from surffollow.config.stop_causes import STOP_NAMES
from surffollow.shm import cheader
from surffollow.shm import layout_adaptive as la
from surffollow.shm import layout_board as lb
from surffollow.shm import layout_follow as lf
from surffollow.shm import layout_slot as ls
from surffollow.shm import map_layout as ml
from surffollow.shm.bit_names import GRANT_NAMES, SERVICE_FAULT_NAMES
from surffollow.shm.request_table import REQUESTS, Argument

_PREFIXES = {"request": "RQ_", "board_state": "STATE_", "access": "ACCESS_"}
_STEPS = ("SLOT_ASK", "SLOT_OFFER", "SLOT_MAPPED", "SLOT_GRANT", "SLOT_REFUSE")
_REFUSALS = (
    *("SLOT_OK", "SLOT_ALL_TAKEN", "SLOT_USER_LIMIT"),
    *("SLOT_PROCESS_LIMIT", "SLOT_OTHER_RUN", "SLOT_BAD_MESSAGE"),
)


def enums() -> dict[str, dict[str, int]]:
    def numbered(names: tuple[str, ...]) -> dict[str, int]:
        return {name: k for k, name in enumerate(names)}

    return {
        **{name: lb.codes(prefix) for name, prefix in _PREFIXES.items()},
        "slot_step": {n: int(getattr(ls, n)) for n in _STEPS},
        "slot_result": {n: int(getattr(ls, n)) for n in _REFUSALS},
        "map_state": numbered(ml.STATE_NAMES),
        "map_rounding": numbered(ml.ROUNDING_NAMES),
        "health": numbered(la.HEALTH_NAMES),
        "mode": numbered(PARAMS["mode"].choices),
        "run": numbered(PARAMS["run"].choices),
    }


def bits() -> dict[str, dict[str, int]]:
    """Name → bit number, by the word that the bits are in."""
    status = {name: k for k, name in enumerate(lf.STATUS_NAMES)}
    stop = {name: k for k, name in enumerate(STOP_NAMES)}
    return {
        "sf_output.status": {**status, "STALE": cheader.STALE.bit_length() - 1},
        "sf_output.faults": {name: k for k, name in enumerate(la.FAULT_NAMES)},
        "sf_output.stop": stop,
        "sf_output.stop_now": stop,
        "sf_params.stop_on": stop,
        "sf_map_header.stop": stop,
        "sf_main_thread_state.faults": {name: k for k, name in enumerate(SERVICE_FAULT_NAMES)},
        "sf_main_thread_state.granted": {name: k for k, name in enumerate(GRANT_NAMES)},
    }


def answer_names() -> dict[int, str]:
    return {**{v: n for n, v in lb.codes("ERR_").items()}, lb.OK: "OK", lb.ACCEPTED: "ACCEPTED"}


def _argument(a: Argument) -> dict[str, Any]:
    if a.count == 0:
        words = f"{a.array}[0..n-1]"
    else:
        words = f"{a.array}[{a.first}]" + (f"..[{a.first + a.count - 1}]" if a.count > 1 else "")
    return {
        "words": words,
        "array": a.array,
        "first": a.first,
        "count": a.count or "n",
        "name": a.name,
        "unit": a.unit,
        "doc": a.doc,
    }


def requests() -> list[dict[str, Any]]:
    names = {v: n for n, v in lb.codes("RQ_").items()}
    answers = answer_names()

    def results_of(results: dict[int, str]) -> list[dict[str, Any]]:
        return [{"result": r, "name": answers[r], "detail": text} for r, text in sorted(results.items())]

    return [
        {
            "code": r.code,
            "name": names[r.code].removeprefix("RQ_"),
            "doc": r.doc,
            "may": r.may,
            "n": r.n or "ignored",
            "arguments": [_argument(a) for a in r.arguments],
            "acks": results_of(r.answers),
            "map_acks": results_of(r.end),
        }
        for r in REQUESTS
    ]


def parameters() -> list[dict[str, Any]]:
    rows = []
    for name, spec in PARAMS.items():
        unit = "" if spec.unit == "1" else spec.unit
        rows.append(
            {
                "name": name,
                "number": lf.Params.offset(name) // 8,
                "type": "int64" if lf.Params.field(name).code == "i8" else "double",
                "whole": spec.whole,
                "unit": unit,
                "low": spec.low,
                "high": spec.high,
                "default": spec.default,
                "choices": list(spec.choices),
                "doc": lf.Params.field(name).doc,
            }
        )
    return rows
