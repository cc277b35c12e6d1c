"""The map from C: laid over a region, looked up, held still, written to a file that any release reads."""

from __future__ import annotations

import errno
import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from cabi.running import PATIENT_MS, Probe, flat_ground
from running_service import Service, quickest, until
from surffollow.client import Client, attach, observe
from surffollow.client.map_reader import copy_map
from surffollow.errors import RefusedError, RequestTimeoutError
from surffollow.map import HeightMap
from surffollow.map.formats.text_file import OTHER_SUFFIXES
from surffollow.map.kernels.lookup import height_at
from surffollow.shm import map_layout as ml
from surffollow.shm.layout_follow import POSE_STALE

OK, UNKNOWN = 0, 4
REGION = "0 0 0.1 0.08"


@pytest.fixture
def robot(service: Service) -> Iterator[Client]:
    with attach(service.name, label="python", stale_min_s=PATIENT_MS / 1000) as client:
        yield client


@pytest.fixture
def probe(make_probe: Callable[..., Probe], service: Service) -> Probe:
    """A probe over a map with a line of samples across it."""
    p = make_probe()
    assert p(f"attach {service.name}").result == OK
    assert p(f"map_reset {REGION}").result == OK
    before, cycle = p("status").values[4], p("status").values[2]
    # the sensor stands still: a tool that came down without it would have an unresponsive one
    assert p("ee 0.01 0.04 0.1 0 0 0 1").result == OK
    cycle = p.until("status", lambda a, last=cycle: a.values[2] >= last + 4).values[2]
    assert p("reset 0.1").result == OK
    for k in range(40):
        pose = f"ee {0.002 * k + 0.01} 0.04 {0.1 + 0.0005 * k} 0 0 0 1"
        assert p(pose).result == OK
        cycle = p.until("status", lambda a, last=cycle: a.values[2] >= last + 4).values[2]
    p.until(pose, lambda _: p("status").values[4] > before + 40)
    return p


def settle(probe: Probe, robot: Client) -> None:
    """Wait until the pose is stale, so that no sample comes any more, and all that came were applied."""
    probe.until("dev", lambda a: int(a.values[2]) & POSE_STALE != 0)
    until(lambda: (s := robot.status())["map"]["applied"] == s["samples"], "an empty queue")


def test_heights_in_c_are_those_of_the_kernel(probe: Probe, robot: Client) -> None:
    settle(probe, robot)
    header, pairs = copy_map(robot, 5.0)
    assert HeightMap(header, pairs).samples > 40
    known = 0
    for x_m, y_m in np.random.default_rng(7).uniform(0.0, 0.1, (60, 2)).tolist() + [
        (0.002 * k + 0.01, 0.04) for k in range(40)
    ]:
        expected, is_known = height_at(header, pairs, x_m, y_m)
        answer = probe(f"height {x_m!r} {y_m!r}")
        assert answer.result == (OK if is_known else UNKNOWN), (x_m, y_m)
        if is_known:
            assert answer.values == [expected]
            known += 1
    assert known >= 20


def test_surface_in_c_is_pythons(probe: Probe, robot: Client) -> None:
    settle(probe, robot)
    points = np.random.default_rng(8).uniform(-0.005, 0.105, (80, 2)).tolist()
    points += [(0.0013 * k + 0.01, 0.04 + 0.0001 * (k % 5)) for k in range(60)]
    known = slopes = 0
    for x_m, y_m in points:
        expected = robot.map_surface(x_m, y_m)
        answer = probe(f"surface {x_m!r} {y_m!r}")
        assert answer.result == (OK if expected.known else UNKNOWN), (x_m, y_m)
        if expected.known:
            known += 1
            slopes += expected.slope_x == expected.slope_x
            np.testing.assert_allclose(answer.values, expected[:3], rtol=1e-12, atol=1e-12)
    assert known >= 20
    assert slopes >= 20
    for point in ("9 9", "nan 0", "0 inf", "1e300 1e300"):
        assert probe(f"surface {point}").result == UNKNOWN, point


def test_points_that_no_map_has_are_unknown(probe: Probe) -> None:
    for point in ("9 9", "-9 0", "nan 0", "0 inf", "1e300 1e300", "-0.0001 -1e-300"):
        assert probe(f"height {point}").result == UNKNOWN, point


def test_uploaded_file_is_the_python_clients_byte_for_byte(
    probe: Probe, robot: Client, tmp_path: Path
) -> None:
    settle(probe, robot)
    assert probe(f"upload {tmp_path / 'c.txt'}").result == OK
    robot.upload_map(tmp_path / "python.txt")
    assert (tmp_path / "c.txt").read_text() == (tmp_path / "python.txt").read_text()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c.txt", "python.txt"]


def test_upload_that_cannot_be_written_leaves_nothing_behind(probe: Probe, tmp_path: Path) -> None:
    (tmp_path / "taken").mkdir()
    answer = probe(f"upload {tmp_path / 'taken'}")
    assert answer.result == -32
    assert answer.detail in (17, 21, 39)
    assert probe(f"upload {tmp_path / 'no/such/folder'}").result == -32
    assert [p.name for p in tmp_path.iterdir()] == ["taken"]
    assert probe("begin 60000").result == OK  # access was given back
    assert probe("end").result == OK


def test_refocus_keeps_heights_and_reset_clears_them(probe: Probe) -> None:
    assert probe("map_refocus 0.02 0.02 0.06 0.06").result == OK
    assert probe("map_refocus 0.02 0.02 0.06 0.06 0.004").result == OK
    assert probe("map_refocus 0.02 0.02 0.06 0.06 1e-7").result == -1
    assert probe("height 0.04 0.04").result == OK
    assert probe("map_reset 0.02 0.02 0.06 0.06").result == OK
    assert probe("height 0.021 0.059").result == UNKNOWN


@pytest.mark.parametrize(
    "region", ["0 0 0 1", "0 0 1 -1", "0 0 nan 1", "0 0 inf 1", "0 0 2e6 1", "1 1 0.5 2"]
)
def test_regions_without_an_area_are_refused_at_once(probe: Probe, region: str) -> None:
    assert probe(f"map_reset {region}").result == -6
    assert probe(f"map_refocus {region}").result == -6


def test_map_stands_still_while_a_c_client_holds_it_and_following_goes_on(
    probe: Probe, robot: Client
) -> None:
    assert probe("begin 60000").result == OK
    assert probe("held").result == 1
    assert robot.status()["map"]["access_slot"] == probe("held").slot
    _, _, cycles, _, applied, *_ = probe("status").values
    seen = set()
    while (now := probe("status").values)[2] <= cycles + 40:
        assert probe("ee 0.05 0.05 0.1 0 0 0 1").result == OK
        seen.add(now[4])
    assert seen == {applied}
    with pytest.raises(RequestTimeoutError), robot.exclusive(timeout_s=0.05):
        pass
    assert probe("end").result == OK
    probe.until("status", lambda a: a.values[4] > applied)  # the queue is applied
    with robot.exclusive():
        assert probe("begin 50").result == -27


@pytest.fixture(scope="module")
def short_lease_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service whose lease is 0.7 s, for those who outlive it."""
    with Service(tmp_path_factory.mktemp("hasty"), flat_ground("700 ms")).running() as s:
        yield s


def test_holder_that_outlives_its_lease_learns_that_its_copy_may_be_mixed(
    make_probe: Callable[..., Probe], short_lease_service: Service
) -> None:
    probe = make_probe()
    assert probe(f"attach {short_lease_service.name}").result == OK
    assert probe("begin 60000").result == OK
    probe.until("held", lambda a: a.result == 0)  # the service's lease is 0.7 s
    cycles = probe("status").values[2]
    # and it is not granted again behind the holder's back
    probe.until("status", lambda a: probe("held").result != 0 or a.values[2] > cycles + 20)
    assert probe("held").result == 0
    assert probe("end").result == -31
    probe.until("holding 60000 0", lambda a: a.result == OK)


def test_killed_holder_does_not_keep_the_map(
    probe: Probe, make_probe: Callable[..., Probe], service: Service
) -> None:
    assert probe("begin 60000").result == OK
    probe.process.kill()
    probe.process.wait()
    other = make_probe()
    other(f"attach {service.name}")
    assert other("begin 60000").result == OK
    assert other("end").result == OK


def test_damaged_geometry_leads_no_reader_out_of_the_map(probe: Probe, service: Service) -> None:
    """The map's writer is trusted; a reader of a damaged copy still stays inside its mapping."""
    probe.until("ee 0.05 0.04 0.1 0 0 0 1", lambda _: probe("height 0.05 0.04").result == OK)
    live, copy = Path(f"/dev/shm/{service.name}"), Path(f"/dev/shm/cabi-copy-{os.getpid()}")
    board, map_ = live.read_bytes(), bytearray(live.with_name(live.name + ".map").read_bytes())
    at = ml.MapHeader.offset("nx")
    copied_map = copy.with_name(copy.name + ".map")
    assert probe("detach").result == OK
    try:
        copy.write_bytes(board)
        copied_map.write_bytes(map_)
        assert probe(f"observe {copy.name}").result == OK
        assert probe("height 0.05 0.04").result == OK
        assert probe("detach").result == OK
        copied_map.write_bytes(map_[: ml.MapHeader.SIZE + 100])  # less than the header's page
        for call in ("observe " + copy.name, "height 0.05 0.04", "surface 0.05 0.04"):
            assert probe(call).result == (OK if "observe" in call else -24), call
        assert probe("detach").result == OK
        copied_map.write_bytes(map_)
        if os.geteuid() == 0:
            os.chown(copied_map, 12345, -1)  # another user's, under the name of the service's
            assert probe(f"observe {copy.name}").result == OK
            assert probe("height 0.05 0.04").result == -24
            assert probe("detach").result == OK
            os.chown(copied_map, 0, -1)
        assert probe(f"observe {copy.name}").result == OK
        for nx in (1 << 62, -1, 0, 10**9):
            with copied_map.open("r+b") as f:
                f.seek(at)
                f.write(struct.pack("<q", nx))
            assert probe("height 0.05 0.04").result == UNKNOWN, nx
    finally:
        copy.unlink()
        copied_map.unlink()


def test_grant_of_a_killed_holder_is_not_taken_for_the_next_clients(
    make_probe: Callable[..., Probe], service: Service, robot: Client
) -> None:
    for _ in range(6):
        victim, heir = make_probe(), make_probe()
        victim(f"attach {service.name}")
        assert victim("begin 60000").result == OK
        before = robot.status()["map"]["grants"]
        victim.process.kill()
        victim.process.wait()
        assert heir(f"attach {service.name}").result == OK
        assert heir("begin 60000").result == OK
        assert robot.status()["map"]["grants"] > before, "a grant of its own"
        assert heir("end").result == OK
        heir("detach")


def victim_slot(robot: Client) -> int:
    """The lowest slot beside the one that the robot has."""
    return 0 if robot.slot else 1


def test_grant_given_anew_behind_the_holders_back_is_not_its_own(
    make_probe: Callable[..., Probe], short_lease_service: Service
) -> None:
    """The service's lease is 0.7 s: a holder that sleeps longer gets an error, after any sleep."""
    probe, name = make_probe(), short_lease_service.name
    assert probe(f"attach {name}").result == OK
    for over_ms in (800, 1600):
        assert probe(f"holding 60000 {over_ms}").result == -31
        probe.until("holding 60000 0", lambda a: a.result == OK)  # it is heard again
    patience = PATIENT_MS / 1000
    with attach(name, stale_min_s=patience) as slow, observe(name, stale_min_s=patience) as watcher:
        before, cycles = watcher.status()["map"]["grants"], watcher.status()["cycles"]
        with pytest.raises(RefusedError, match="taken back"), slow.exclusive():
            until(lambda: watcher.status()["cycles"] > cycles + 1600, "two leases and more")
        assert watcher.status()["map"]["grants"] == before + 1, "a fenced holder gets no second grant"
        until(lambda: holds_for_a_moment(slow), "access once more")


def holds_for_a_moment(client: Client) -> bool:
    """Take and give back the map; False when this process slept through the lease."""
    try:
        with client.exclusive(timeout_s=60.0):
            return True
    except RefusedError:
        return False


def test_access_nests_and_its_holder_is_not_made_to_wait_for_itself(
    probe: Probe, robot: Client, tmp_path: Path
) -> None:
    assert probe("end").result == -31, "nothing was begun"
    assert probe("begin 60000").result == OK
    assert probe("begin 60000").result == OK
    assert probe("end").result == OK
    assert probe(f"upload {tmp_path / 'inside.txt'}").result == OK
    assert probe("held").result == 1
    for ask in ("map_reset", "map_refocus"):
        assert quickest(lambda ask=ask: refused(probe, ask)) < 0.1
    assert probe("end").result == OK
    assert probe("held").result == 0
    with robot.exclusive():
        pass
    assert probe(f"map_reset {REGION}").result == OK


def refused(probe: Probe, ask: str) -> None:
    assert probe(f"{ask} {REGION}").result == -35


@pytest.mark.parametrize("kind", ["pipe", "device", "link to a pipe"])
def test_upload_leaves_what_is_no_plain_file(probe: Probe, tmp_path: Path, kind: str) -> None:
    target = tmp_path / "there"
    if kind == "device":
        target = Path("/dev/null")
    else:
        os.mkfifo(tmp_path / "pipe" if "link" in kind else target)
        if "link" in kind:
            target.symlink_to("pipe")
    before = os.lstat(target)
    answer = probe(f"upload {target}")
    assert (answer.result, answer.detail) == (-32, errno.EEXIST)
    assert os.lstat(target).st_ino == before.st_ino


def test_upload_follows_links_and_keeps_the_files_mode(probe: Probe, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    real = tmp_path / "folder" / "real.txt"
    real.write_text("old")
    real.chmod(0o600)
    (tmp_path / "one").symlink_to("folder/two")
    (tmp_path / "folder" / "two").symlink_to("real.txt")
    (tmp_path / "new").symlink_to("folder/made.txt")
    assert probe(f"upload {tmp_path / 'one'}").result == OK
    assert (tmp_path / "one").is_symlink()
    assert real.read_text().startswith("surffollow-map 1")
    assert real.stat().st_mode & 0o777 == 0o600
    assert probe(f"upload {tmp_path / 'new'}").result == OK
    assert (tmp_path / "folder" / "made.txt").read_text().startswith("surffollow-map 1")
    (tmp_path / "round").symlink_to("round")
    assert probe(f"upload {tmp_path / 'round'}").result == -32
    assert sorted(p.name for p in (tmp_path / "folder").iterdir()) == ["made.txt", "real.txt", "two"]


@pytest.mark.parametrize("suffix", [*OTHER_SUFFIXES, ".PNG"])
def test_upload_refuses_the_suffixes_that_are_other_formats_for_the_python_client(
    probe: Probe, robot: Client, tmp_path: Path, suffix: str
) -> None:
    target = tmp_path / f"map{suffix}"
    answer = probe(f"upload {target}")
    assert (answer.result, answer.detail) == (-32, errno.EINVAL)
    assert not list(tmp_path.iterdir())
    if suffix in (".npz", ".PNG"):
        robot.upload_map(target)
        assert target.read_bytes().startswith(b"PK" if suffix == ".npz" else b"\x89PNG")


@pytest.mark.parametrize("name", ["map", "map.npz.txt", ".png", "map.tif.", "folder.tif/map"])
def test_upload_goes_by_the_last_suffix_of_the_name_alone(
    probe: Probe, robot: Client, tmp_path: Path, name: str
) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    assert probe(f"upload {tmp_path / name}").result == OK
    robot.upload_map(tmp_path / name)


def test_parts_that_a_killed_upload_left_hinder_no_later_one(probe: Probe, tmp_path: Path) -> None:
    (tmp_path / f"map.txt.{probe.pid}.part").write_text("left")
    assert probe(f"upload {tmp_path / 'map.txt'}").result == OK
