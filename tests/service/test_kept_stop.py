"""A stop outlives the purge of the map that holds it: controllers attach to the next start by themselves."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from running_service import Service, drive, objects_of, unique_name, until
from second_user import NOBODY, as_other_user, needs_root, outcome
from surffollow.cli.service import purge_leftovers
from surffollow.client import Client
from surffollow.errors import NoPermissionError
from surffollow.service import shared_objects
from surffollow.service.kept_stop import NOTHING, KeptStop, keep_stop, read_kept_stop
from surffollow.service.name_owner import remove_all
from surffollow.service.shared_objects import open_shared_objects
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_board import STATE_READY
from surffollow.shm.layout_follow import STOP_REQUEST, STOP_START
from surffollow.shm.objects import SHM_ROOT

Make = Callable[..., Service]


@pytest.fixture
def name() -> Iterator[str]:
    """A name of no service; its objects are removed at the end."""
    made = unique_name("kept")
    yield made
    for part in objects_of(made):
        (SHM_ROOT / part).unlink()


def valid(client: Client) -> bool:
    return client.dev_vector().valid


def purged(service: Service) -> bool:
    """Stop and purge; whether a stop was kept, which the standard error says, too."""
    done = service.run("stop", "--purge", "--json")
    assert done.returncode == 0, done.stderr
    kept = bool(json.loads(done.stdout)["stop_kept"])
    assert ("is kept for the next start" in done.stderr) == kept
    return kept


def test_a_latched_stop_outlives_a_purge_and_a_start_with_other_memory(killable: Service) -> None:
    # GIVEN a controller that goes on, and a stop
    with killable.attach() as driver:
        drive(driver, lambda: valid(driver), what="a demand")
        driver.stop("a person came near")
        drive(driver, lambda: driver.status()["stopped"] == ["request"], what="the stop")
        # WHEN the service is purged, twice, and starts with room for another number of grids
        assert purged(killable)
        assert objects_of(killable.name) - {f"{killable.name}.world", f"{killable.name}.world.lock"} == {
            f"{killable.name}.stop"
        }
        again = killable.run("stop", "--purge")
        assert again.returncode == 1
        assert "latched stop (request) is kept" in again.stderr
        killable._reap()
        killable.config.write_text(killable.config.read_text().replace("grids = 20000", "grids = 30000"))
        killable.start()
        assert f"{killable.name}.stop" not in objects_of(killable.name), "it stands in the map"
        # THEN it is stopped until the holder resets it
        drive(driver, lambda: driver.status()["stopped"] == ["request"], what="the stop of the next one")
        assert not valid(driver)
        drive(driver, lambda: driver.slot >= 0, what="a slot of the new one")
        driver.reset_stop()
        drive(driver, lambda: valid(driver), what="a demand after the reset")
        driver.release_pose()
        until(lambda: driver.status()["main"]["pose_slot"] == -1, "the pose is free")
        assert not purged(killable), "a stop that was reset is over"
        killable._reap()


def test_an_end_says_that_a_stop_is_kept_and_the_next_start_says_why_it_is_stopped(
    killable: Service, tmp_path: Path
) -> None:
    # GIVEN a stop WHEN the service is ended without a purge THEN that says so
    with killable.attach() as driver:
        driver.stop("a person came near")
    done = killable.run("stop", "--json")
    assert json.loads(done.stdout)["stop_kept"] is True
    assert "latched stop (request) is kept for the next start" in done.stderr
    killable._reap()
    # AND the next start has a line with cause and remedy, and an entry of the audit trail
    killable.start_logged(log := tmp_path / "log")
    assert "starts with a latched stop (request): no demand is valid until the pose's holder resets it" in (
        text := log.read_text()
    )
    assert "simulate --reset-stop" in text
    entry_line = f"audit: pid {killable.pid} uid {os.geteuid()} service: stop (request) "
    assert entry_line + '"kept from before this start": ok' in text
    with killable.observe() as watcher:
        (entry,) = watcher.audit()
        assert (entry["client"], entry["request"], entry["causes"]) == ("service", "stop", ["request"])
    shown = killable.run("status").stdout
    assert re.search(r"STOPPED  request; until .*\n +since .* request: kept from before this start\n", shown)
    # AND after a reset none of it
    with killable.attach() as driver:
        drive(driver, lambda: driver.status()["poses"] > 0, what="a pose")
        driver.reset_stop()
    done = killable.run("stop", "--json")
    assert json.loads(done.stdout)["stop_kept"] is False
    assert done.stderr == ""
    killable._reap()
    killable.start_logged(log)
    assert "stop" not in log.read_text()


def test_a_killed_service_that_no_robot_used_leaves_no_mark(killable: Service) -> None:
    killable.kill()
    assert not purged(killable)
    assert objects_of(killable.name) - {f"{killable.name}.world", f"{killable.name}.world.lock"} == set()
    # AND parameters that a client set without the pose are no robot's either, those of a holder are
    killable.start()
    with killable.attach() as client:
        client.sf_reset(0.09)
        client.set_params(max_demand=0.011)
        killable.kill()
    assert not purged(killable)
    killable.start()
    with killable.attach() as client:
        client.sf_reset(0.09)
        client.claim_pose()
        killable.kill()
    assert purged(killable)


@pytest.mark.parametrize("end", ["killed", "ended"])
def test_parameters_in_force_under_a_robot_stop_the_next_start_after_a_purge(
    killable: Service, end: str
) -> None:
    with killable.attach() as driver:
        driver.sf_reset(0.09)
        drive(driver, lambda: valid(driver), what="a demand")
        if end == "killed":
            killable.kill()
        assert purged(killable)
        if end == "ended":
            killable._reap()
        killable.start()
        drive(driver, lambda: driver.status()["stopped"] == ["restart"], what="the stop")
        assert not valid(driver)


def put_map(name: str, **fields: int) -> Path:
    """An object NAME.map that begins with a header of these fields."""
    header = zeros(ml.MapHeader)
    header["magic"], header["layout_hash"] = ml.MAGIC, ml.LAYOUT_HASH
    for field, value in fields.items():
        header[field] = value
    path = SHM_ROOT / f"{name}.map"
    path.write_bytes(header.tobytes())
    return path


def test_what_is_kept_is_what_the_map_says(name: str) -> None:
    assert keep_stop(name) == NOTHING
    put_map(name)
    assert keep_stop(name) == NOTHING
    assert objects_of(name) == {f"{name}.map"}
    for kept in (KeptStop(STOP_REQUEST, 0), KeptStop(0, -5), KeptStop(STOP_REQUEST, 1 << 62)):
        put_map(name, stop=kept.causes, params_hash=kept.params_hash)
        assert keep_stop(name) == kept
        assert read_kept_stop(name) == kept
        assert (SHM_ROOT / f"{name}.stop").stat().st_mode & 0o777 == 0o600
    remove_all(name)
    assert objects_of(name) == set()


@pytest.mark.parametrize(
    "text", ["what\n", "", "4", "-1 0", "99999999999999999999999 5", f"4 {1 << 63}", f"{1 << 63} 0", "4 0 0"]
)
def test_what_cannot_be_read_begins_stopped(name: str, text: str) -> None:
    put_map(name, layout_hash=1)
    assert keep_stop(name) == KeptStop(STOP_START, 0), "a map of another release"
    (SHM_ROOT / f"{name}.stop").write_text(text)
    assert read_kept_stop(name) == KeptStop(STOP_START, 0)


@needs_root
def test_a_stop_that_root_keeps_for_a_user_belongs_to_that_user(name: str) -> None:
    os.chown(put_map(name, stop=STOP_REQUEST), NOBODY, -1)
    keep_stop(name)
    assert (SHM_ROOT / f"{name}.stop").stat().st_uid == NOBODY
    # AND a second purge, without the map, says for whom it is kept
    assert purge_leftovers(name)[0]
    removed, said = purge_leftovers(name)
    assert not removed
    assert f"latched stop (request) is kept for the next start by user {NOBODY}" in said


@needs_root
@pytest.mark.parametrize("mode", [0o644, 0o600])
@pytest.mark.parametrize("text", ["4 0", "99999999999999999999999 5", "what"])
def test_a_stop_that_another_user_put_there_is_refused_and_the_start_leaves_nothing(
    make_service: Make, text: str, mode: int
) -> None:
    s = make_service()
    path = SHM_ROOT / f"{s.name}.stop"
    path.write_text(text)
    path.chmod(mode)
    os.chown(path, NOBODY, NOBODY)
    with pytest.raises(NoPermissionError, match=f"belongs to user {NOBODY}, expected user 0") as refused:
        open_shared_objects(s.settings())
    assert f"let user {NOBODY} or root remove it (rm {path}), or choose another name" in str(refused.value)
    assert objects_of(s.name) == {path.name}
    # a purge of root's map does not carry it on
    put_map(s.name)
    with pytest.raises(NoPermissionError, match=f"belongs to user {NOBODY}"):
        keep_stop(s.name)
    put_map(s.name, stop=STOP_REQUEST)
    assert keep_stop(s.name) == KeptStop(STOP_REQUEST, 0)
    assert path.stat().st_uid == 0


@needs_root
def test_a_user_without_rights_reads_the_same_of_a_file_that_is_closed_to_him(name: str) -> None:
    path = SHM_ROOT / f"{name}.stop"
    path.write_text("4 0")
    path.chmod(0o600)
    said = as_other_user(lambda _: outcome(lambda: read_kept_stop(name)))
    assert f"belongs to user 0, expected user {NOBODY}" in said
    assert f"rm {path}" in said


def test_what_is_put_in_the_place_during_a_start_does_not_end_it(make_service: Make) -> None:
    s = make_service()
    objects = open_shared_objects(s.settings())
    path = SHM_ROOT / f"{s.name}.stop"
    path.mkdir()  # a file would do for a service without root's rights
    try:
        objects.set_state(STATE_READY)
    finally:
        objects.leave()
        path.rmdir()


def test_a_start_that_fails_with_all_objects_made_leaves_nothing(
    make_service: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    s = make_service()
    monkeypatch.setattr(shared_objects, "read_kept_stop", lambda _: KeptStop(10**30, 0))
    with pytest.raises(OverflowError):
        open_shared_objects(s.settings())
    assert objects_of(s.name) == set()
