"""A client that knows the layout's JSON and the document's rules only does all that ours does."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from running_service import Service, config_text, until
from surffollow.config.params import PARAMS
from surffollow.shm.layout_json import layout_document

PROGRAM = Path(__file__).with_name("foreign_client.py")
POSE = [0.05, 0.05, 0.1, 0.0, 0.0, 0.0, 1.0]
REGION = {"x_min": 0.0, "y_min": 0.0, "x_max": 0.1, "y_max": 0.05}
# neither the environment nor an installed package leads it to ours
ALONE = [sys.executable, "-I", "-S"]


class Foreign:
    """The program as a process; verbs are its own."""

    def __init__(self, layout: Path, name: str) -> None:
        pipe = subprocess.PIPE
        command = [*ALONE, str(PROGRAM), str(layout), name]
        self.process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True)
        self.hello = self._line()

    def _line(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        return dict(json.loads(self.process.stdout.readline()))

    def ask(self, *words: Any) -> dict[str, Any]:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(words) + "\n")
        self.process.stdin.flush()
        return self._line()

    def __call__(self, *words: Any) -> Any:
        answer = self.ask(*words)
        assert "error" not in answer, answer
        return answer["is"]

    def until_valid(self) -> dict[str, Any]:
        """Send the pose until the demand is valid and rests on a reading; that demand."""

        def step() -> Any:
            self("pose", *POSE)
            demand = self("demand")
            return demand if demand["valid"] and demand["range_m"] is not None else None

        return dict(until(step, "a valid demand"))

    def end(self) -> None:
        self.process.kill()
        self.process.communicate()


@pytest.fixture(scope="module")
def layout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output of the command."""
    path = tmp_path_factory.mktemp("layout") / "layout.json"
    command = [sys.executable, "-m", "surffollow", "print-header", "--json"]
    path.write_text(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    return path


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service whose simulated sensor takes its pose from the reports of the foreign client."""
    with Service(tmp_path_factory.mktemp("service"), config_text(kind="simulated")).running() as s:
        yield s


@pytest.fixture
def foreign(layout: Path, service: Service) -> Iterator[Foreign]:
    """A foreign client with a slot and the pose."""
    f = Foreign(layout, service.name)
    try:
        f("attach")
        until(lambda: f("request", "CLAIM_POSE", {})[0] == "OK", "a free pose")
        yield f
    finally:
        f.end()


def test_the_foreign_program_cannot_import_this_package() -> None:
    done = subprocess.run([*ALONE, "-c", "import surffollow"], capture_output=True, text=True)
    assert "ModuleNotFoundError" in done.stderr
    assert "surffollow" not in {
        line.split()[1] for line in PROGRAM.read_text().splitlines() if "import " in line[:7]
    }


def test_it_drives_and_its_stand_off_and_parameters_are_in_force(foreign: Foreign, service: Service) -> None:
    assert foreign("request", "SF_RESET", {"offset_m": 0.1}) == ["OK", 0]
    first = foreign.until_valid()
    assert first["range_m"] == pytest.approx(0.1, abs=2e-3)
    assert foreign("request", "SF_RESET", {"offset_m": 0.09}) == ["OK", 0]
    assert foreign("params")["offset_m"] == 0.09
    assert until(lambda: abs(foreign.until_valid()["demand"][2] + 0.01) < 1e-3, "a demand 10 mm down")

    expected = {"permitted_variance_m": 2e-4, "range_size": 7}
    assert foreign("set_params", expected) == ["OK", 0]
    with service.observe() as watcher:
        ours = watcher.params()
        names = [c["name"] for c in watcher.clients()]
    assert {n: ours[n] for n in expected} == expected
    assert foreign("params") == ours
    assert any(n.startswith("foreign ") for n in names)


def test_it_learns_which_parameter_was_wrong(foreign: Foreign) -> None:
    numbers = {p["number"]: p["name"] for p in layout_document()["parameters"]}
    for name, spec in PARAMS.items():
        if not math.isfinite(spec.high):
            continue
        result, detail = foreign("set_params", {name: 2 * spec.high + 1})
        assert (result, numbers[detail]) == ("ERR_BAD_VALUE", name)
    too_many = {"parameter": [0] * 0, "value": []}
    assert foreign("request", "SET_PARAMS", too_many) == ["ERR_BAD_VALUE", -1]


def test_another_client_is_refused_the_pose_with_the_holders_pid(
    foreign: Foreign, layout: Path, service: Service
) -> None:
    other = Foreign(layout, service.name)
    try:
        other("attach")
        pid = foreign.process.pid
        assert other("request", "CLAIM_POSE", {}) == ["ERR_POSE_HELD", pid]
        assert other("request", "SF_RESET", {"offset_m": 0.1}) == ["ERR_NOT_POSE_HOLDER", pid]
        assert foreign("request", "RELEASE_POSE", {}) == ["OK", 0]
        assert foreign("request", "RELEASE_POSE", {})[0] == "ERR_NOT_HOLDER"
        assert other("request", "CLAIM_POSE", {}) == ["OK", 0]
    finally:
        other.end()


def test_it_stops_with_a_reason_and_leaves_the_stop(foreign: Foreign, service: Service) -> None:
    foreign.until_valid()
    reason = [int.from_bytes(b"far away"[k : k + 8], "little") for k in range(0, 64, 8)]
    assert foreign("request", "STOP", {"reason": reason})[0] == "OK"
    stopped = until(lambda: (d := foreign("demand"))["stop"] and d, "the stop")
    assert (stopped["valid"], stopped["stop"], stopped["demand"]) == (False, ["request"], [0.0] * 6)
    assert "STOPPED" in stopped["status"]
    with service.observe() as watcher:
        until(lambda: any(e.get("reason") == "far away" for e in watcher.audit()), "the audit entry")
    assert foreign("request", "STOP_RESET", {}) == ["OK", 0]
    foreign.until_valid()


def test_it_lays_refocuses_installs_and_holds_the_map(foreign: Foreign) -> None:
    assert foreign("request", "MAP_RESET", REGION) == ["OK", 0]
    assert foreign("map")["region_m"] == [*REGION.values()]
    half = {**REGION, "x_max": 0.05}
    assert foreign("request", "MAP_REFOCUS", {**half, "finest_grid_m": 0.0}) == ["OK", 0]
    assert foreign("map")["region_m"] == [*half.values()]
    assert foreign("request", "MAP_REFOCUS", {**half, "finest_grid_m": 0.005}) == ["OK", 0]
    assert foreign("map")["grid_m"] == 0.005
    assert foreign("request", "MAP_REFOCUS", {**half, "finest_grid_m": -1.0}) == ["ERR_BAD_VALUE", -1]
    # a simulated sensor takes no ranges: it has 0 channels for them
    assert foreign("request", "CLAIM_RANGE", {"channel": 0}) == ["ERR_NO_CHANNEL", 0]
    assert foreign("request", "MAP_RESET", {**REGION, "x_max": 0.0}) == ["ERR_BAD_REGION", 0]

    geometry = {"grid_m": 0.01, "x0_m": 0.01, "y0_m": 0.02, "datum_m": 0.002, "quantum_m": 25.4e-6}
    geometry |= {"nx": 4, "ny": 2, "datum_set": 1}
    region = {"x_min": 0.01, "y_min": 0.02, "x_max": 0.05, "y_max": 0.04}
    announced = {**region, **geometry}
    heights = [0, 10, -10, 100, -100, 7, -32768, 1]
    assert foreign("install", announced, heights, [1, 2, 3, 4, 5, 6, 0, 8]) == ["OK", 0]
    found = foreign("map")
    assert {k: found[k] for k in geometry} == geometry
    assert found["region_m"] == [*region.values()]
    expected = [None if h == -32768 else 0.002 + 25.4e-6 * h for h in heights]
    assert found["grids"] == [w if w is None else pytest.approx(w, abs=1e-12) for w in expected]

    until(lambda: foreign("enter"), "exclusive access")
    assert foreign("exit")
    until(lambda: foreign("enter"), "exclusive access again")
    assert foreign("exit")


def test_a_new_holder_of_a_slot_begins_anew_and_every_request_is_answered(
    layout: Path, service: Service
) -> None:
    slots, claims = set(), []
    f = Foreign(layout, service.name)
    try:
        for _ in range(20):
            slot, claim = f("attach")
            slots.add(slot)
            claims.append(claim)
            until(lambda: f("request", "CLAIM_POSE", {})[0] == "OK", "a free pose")
            assert f("request", "SF_RESET", {"offset_m": 0.1}) == ["OK", 0]
            f.until_valid()
            f("leave")
    finally:
        f.end()
    assert len(slots) < len(claims) == len(set(claims)), "slots come back, claims do not"


def test_it_follows_a_killed_service_to_its_next_start(foreign: Foreign, service: Service) -> None:
    before = foreign.until_valid()
    assert foreign("request", "SF_RESET", {"offset_m": 0.09}) == ["OK", 0]
    service.kill()
    silent = until(lambda: "STALE" in (d := foreign("demand"))["status"] and d, "a stale demand")
    assert (silent["valid"], silent["demand"]) == (False, [0.0] * 6)
    assert "error" in foreign.ask("request", "SF_RESET", {"offset_m": 0.1})

    service.start()
    fresh = until(lambda: "STALE" not in (d := foreign("demand"))["status"] and d, "the next start")
    assert fresh["epoch"] > before["epoch"]
    foreign("attach")
    assert foreign("request", "CLAIM_POSE", {}) == ["OK", 0]
    stopped = until(lambda: "STOPPED" in (d := foreign("demand"))["status"] and d, "the stop of a restart")
    assert (stopped["valid"], stopped["demand"]) == (False, [0.0] * 6)
    assert foreign("request", "SF_RESET", {"offset_m": 0.1}) == ["OK", 0]
    until(lambda: foreign("request", "STOP_RESET", {}) == ["OK", 0], "the reset")
    assert foreign.until_valid()["epoch"] == fresh["epoch"]


def test_an_altered_hash_is_refused(layout: Path, service: Service, tmp_path: Path) -> None:
    altered = json.loads(layout.read_text())
    altered["objects"]["board"]["hash"] = "0x" + 15 * "0" + "1"
    path = tmp_path / "altered.json"
    path.write_text(json.dumps(altered))
    done = subprocess.run([*ALONE, str(PROGRAM), str(path), service.name], capture_output=True, text=True)
    assert "of another release" in done.stderr
    altered = json.loads(layout.read_text())
    altered["handshake"]["hash"] = "0x" + 15 * "0" + "1"
    path.write_text(json.dumps(altered))
    f = Foreign(path, service.name)
    try:
        assert "not of this release's protocol" in f.ask("attach")["error"]
    finally:
        f.end()


def test_status_names_version_and_hashes_as_the_header_does(layout: Path, service: Service) -> None:
    reported = json.loads(service.run("status", "--json").stdout)["layout"]
    header = json.loads(layout.read_text())
    assert reported == {k: header[k] for k in reported}
    assert {"release", "version", "hash", "map_hash"} <= reported.keys()
