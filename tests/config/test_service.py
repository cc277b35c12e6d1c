"""The service's configuration file: accepted keys, and the message of each mistake."""

from __future__ import annotations

import grp
import os

import pytest
from click.testing import CliRunner

from surffollow import Follower
from surffollow.cli.service import start_command
from surffollow.config.group_id import configured_group_id
from surffollow.config.service import (
    ServiceConfig,
    follow_params,
    load_config,
    map_quantum_m,
    map_rounding,
    mode,
    parse_config,
    seconds,
)
from surffollow.errors import ConfigError, InputFileError, InvalidNameError, MapFileError, RegionError
from surffollow.hw.registry import make_driver
from surffollow.service.initialise import initialise_constants
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_follow import Params
from surffollow.shm.objects import unlink

FULL = """
name = "arm2"
period = "0.5 ms"
log_words = 131072
snapshot = "2 s"

[realtime]
priority = 50
cpu = 1
spin = "80 us"
overrun = "catch-up"

[map]
grids = 4000000
finest_grid = "0.1 in"
rounding = "paper"

[access]
board_mode = "0644"
group = "robots"

[driver]
kind = "simulated"

[follow]
mode = "adaptive"
offset = "4 in"
sensor_readings = 5
"""


def test_an_empty_configuration_is_a_valid_one():
    c = parse_config({})
    assert c == ServiceConfig()
    assert seconds(c.period, "period", 0.0, 1.0) == 1e-3
    assert follow_params(c) == {}


def test_a_full_file_is_taken_as_written(tmp_path):
    path = tmp_path / "arm2.toml"
    path.write_text(FULL)
    c = load_config(path)
    assert (c.name, c.log_words, c.realtime.overrun, c.map.grids) == ("arm2", 131072, "catch-up", 4_000_000)
    assert seconds(c.period, "period", 0.0, 1.0) == pytest.approx(0.5e-3)
    assert follow_params(c) == {"mode": 1.0, "offset_m": pytest.approx(0.1016), "sensor_readings": 5.0}


@pytest.mark.parametrize(
    ("data", "says"),
    [
        ({"periode": "1 ms"}, ["periode"]),
        ({"realtime": {"prio": 3}}, ["prio", "realtime"]),
        ({"map": {"gridz": 3}}, ["gridz", "map"]),
        ({"period": "1 mm"}, ["period", "'mm' is a length", "time"]),
        ({"period": "1 fortnight"}, ["period", "unknown unit 'fortnight'"]),
        ({"period": "19.999 us"}, ["period", "between 2e-05 and 1"]),
        ({"period": 5}, ["period", "between 2e-05 and 1 s"]),
        ({"period": [1]}, ["period"]),
        ({"period": "0.001"}, ["key period: '0.001' has no unit", "0.001 without quotes for s"]),
        ({"map": {"gate": "0.01"}}, ["map.gate: '0.01' has no unit", "0.01 without quotes for m"]),
        ({"follow": {"offset": "0.1"}}, ["offset: '0.1' has no unit", "0.1 without quotes for m"]),
        ({"realtime": {"priority": 99}}, ["realtime.priority", "99", "between 1 and 98"]),
        ({"realtime": {"overrun": "panic"}}, ["realtime.overrun", "'skip' or 'catch-up'"]),
        ({"realtime": {"spin": "1 s"}}, ["realtime.spin"]),
        ({"log_words": 100_000}, ["log_words", "power of two"]),
        ({"log_words": 1024}, ["log_words"]),
        ({"log_words": "many"}, ["log_words"]),
        ({"map": {"grids": 0}}, ["map.grids", "1000000000"]),
        ({"map": {"rounding": "up"}}, ["map.rounding", "'unbiased' or 'paper'"]),
        ({"map": {"finest_grid": "-1 mm"}}, ["map.finest_grid"]),
        ({"map": {"quantum": "0 m"}}, ["map.quantum"]),
        ({"map": {"queue_seconds": 0.5}}, ["map.queue_seconds", "between 1 and 600"]),
        ({"map": {"access_lease": "0 s"}}, ["map.access_lease"]),
        ({"access": {"board_mode": "rw-r--"}}, ["access.board_mode", "octal"]),
        ({"access": {"socket_mode": "7777"}}, ["access.socket_mode", "octal"]),
        ({"access": {"socket_mode": "0777"}}, ["access.socket_mode", "execute bits"]),
        ({"access": {"board_mode": "0660"}}, ["access.board_mode", "read it only"]),
        ({"access": {"board_mode": "0646"}}, ["access.board_mode", "read it only"]),
        ({"access": {"map_mode": "0664"}}, ["access.map_mode", "read it only"]),
        ({"follow": {"ofset": 1}}, ["ofset", "did you mean offset_m"]),
        ({"follow": {"offset": "1 s"}}, ["offset", "time"]),
        ({"follow": 3}, ["follow"]),
        ({"follow": {"offset": 0.1, "offset_m": 0.1}}, ["offset_m", "[follow]", "as offset and as offset_m"]),
        ({"follow": {"loss_timeout": 2}}, ["loss_timeout = 2 has no unit", "'2 s' or '30 ms'"]),
        ({"limits": {"offset": "60 mm"}}, ["limits.offset is '60 mm'", 'offset = { max = "20 mm" }']),
        (
            {"access": {"ranges": "no-such-laser"}},
            ["access.ranges: there is no user 'no-such-laser'", "'any', or '' for no other user"],
        ),
        (
            {"access": {"ranges": "a\0b"}},
            ["access.ranges: there is no user 'a\\x00b'"],
        ),
        ({"limits": {"loss_timeout": {"max": 3}}}, ["loss_timeout = 3 has no unit", "'2 s' or '30 ms'"]),
        (
            {"limits": {"max_demand": {"max": 0.05}, "max_demand_m": {"max": 0.05}}},
            ["[limits]", "as max_demand and as max_demand_m"],
        ),
        ({"name": 3}, ["name"]),
    ],
)
def test_a_mistake_is_reported_with_its_key(data, says):
    with pytest.raises(ConfigError) as e:
        parse_config(data, "arm.toml")
    text = str(e.value)
    assert text.startswith("arm.toml: ")
    for part in says:
        assert part in text


def test_a_file_that_cannot_be_read_or_is_no_toml_is_named(tmp_path):
    with pytest.raises(InputFileError, match=r"missing\.toml: No such file"):
        load_config(tmp_path / "missing.toml")
    bad = tmp_path / "bad.toml"
    bad.write_text("period = = 3")
    with pytest.raises(ConfigError, match=r"bad\.toml is not TOML"):
        load_config(bad)
    with pytest.raises(InputFileError, match="Is a directory"):
        load_config(tmp_path)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"a = " + b"[" * 5000 + b"]" * 5000, "nested too deeply"),
        (b"a = " + b"9" * 5000, "is not TOML"),
    ],
    ids=["nested", "digits"],
)
def test_toml_beyond_what_python_parses_is_named(tmp_path, data, says):
    bad = tmp_path / "bad.toml"
    bad.write_bytes(data)
    with pytest.raises(ConfigError, match=rf"bad\.toml.*{says}"):
        load_config(bad)


def test_a_byte_order_mark_is_no_fault(tmp_path):
    path = tmp_path / "notepad.toml"
    path.write_bytes(b'\xef\xbb\xbfname = "cell"\r\n')
    assert load_config(path).name == "cell"


def test_a_pipe_without_a_writer_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "a.toml")
    with pytest.raises(InputFileError, match=r"configuration .*a\.toml: it is a pipe out of which nothing"):
        load_config(tmp_path / "a.toml")


def test_a_pipe_whose_writer_is_slow_is_waited_for(monkeypatch):
    reading, writing = os.pipe()
    set_blocking = os.set_blocking

    def write_late(fd: int, blocking: bool) -> None:  # the first look found nothing
        set_blocking(fd, blocking)
        os.write(writing, b'name = "slow"')
        os.close(writing)

    monkeypatch.setattr(os, "set_blocking", write_late)
    assert load_config(f"/dev/fd/{reading}").name == "slow"
    os.close(reading)


def test_a_device_without_an_end_is_refused_and_a_pipe_is_read():
    with pytest.raises(ConfigError, match=r"/dev/zero has more than 16 MiB"):
        load_config("/dev/zero")
    reading, writing = os.pipe()
    try:
        os.write(writing, b'name = "piped"')
        os.close(writing)
        assert load_config(f"/dev/fd/{reading}").name == "piped"
    finally:
        os.close(reading)


def test_a_file_in_another_encoding_is_reported_and_not_a_crash(tmp_path):
    bad = tmp_path / "latin.toml"
    bad.write_bytes('name = "größe"'.encode("latin-1"))
    with pytest.raises(ConfigError, match=r"latin\.toml"):
        load_config(bad)


@pytest.mark.parametrize(
    ("driver", "key", "expected"),
    [
        ('kind = "replay"\nfile = "log.npz"', "file", "FOLDER/log.npz"),
        ('kind = "replay"\nfile = "../log.npz"', "file", "PARENT/log.npz"),
        ('kind = "replay"\nfile = "/log.npz"', "file", "/log.npz"),
        ('kind = "serial"\nport = "laser"', "port", "FOLDER/laser"),
        ('kind = "serial"\nport = "socket://host:7"', "port", "socket://host:7"),
        ('calibration = "laser.json"', "calibration", "FOLDER/laser.json"),
        ('calibration = ""', "calibration", ""),
        ('kind = "other:make"\ncalibration = "a.json"', "calibration", "FOLDER/a.json"),
        ('kind = "other:make"\nfile = "a.npz"', "file", "a.npz"),
        ('[driver.world]\nfile = "true.npz"', "world", {"file": "FOLDER/true.npz"}),
        ('[driver.world]\nsurface = "flat"', "world", {"surface": "flat"}),
    ],
)
def test_files_lie_beside_the_configuration_file(tmp_path, monkeypatch, driver, key, expected):
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    (folder / "service.toml").write_text(f"[driver]\n{driver}\n")

    def named(value):
        return value.replace("FOLDER", str(folder)).replace("PARENT", str(tmp_path))

    monkeypatch.chdir(tmp_path)
    for path in (folder / "service.toml", "elsewhere/service.toml"):
        found = load_config(path).driver[key]
        wanted = {k: named(v) for k, v in expected.items()} if isinstance(expected, dict) else named(expected)
        assert found == wanted


def test_a_file_that_is_not_there_is_named_with_its_folder(tmp_path, monkeypatch):
    (tmp_path / "arm.toml").write_text('[driver.world]\nfile = "true.npz"\n')
    monkeypatch.chdir(tmp_path)
    config = load_config("arm.toml")
    with pytest.raises(MapFileError) as e:
        make_driver(config.driver, "files")
    assert str(tmp_path / "true.npz") in str(e.value)


@pytest.mark.parametrize(("text", "value"), [("0640", 0o640), ("660", 0o660), ("0", 0), ("666", 0o666)])
def test_modes_are_octal(text, value):
    assert mode(text, "access.socket_mode") == value


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('[driver]\nkind = "telepathy"\n', "driver kind 'telepathy' is unknown"),
        ("[driver]\nchannels = 9\n", "channels = 9"),
        ('[driver]\nrange_max_m = "300"\n', "range_max_m: '300' has no unit; write one, like '300 mm'"),
        ("[follow]\noffset = 0.4\n", "outside the sensor's window"),
        ('[follow]\ntoo_close = "80 mm"\n', "too_close_m 0.08 m is above too_close_exit_m 0.05842 m"),
        ('[follow]\nrange_min = "0.2 m"\n', "range_min_m 0.2 m is not below range_max_m"),
        ('[follow]\ntoo_close_exit = "0.2 m"\n', "too_close_exit_m 0.2 m is not below range_max_m 0.1524 m"),
        (
            '[follow]\noffset = "54 mm"\ntoo_close = "55 mm"\ntoo_close_exit = "56 mm"\n',
            "too_close_m 0.055 m is not below offset_m 0.054 m",
        ),
        ('[follow]\ntoo_close = "40 mm"\n', "too_close_m 0.04 m is below range_min_m 0.0508 m"),
    ],
)
def test_what_start_finds_wrong_later_names_the_file_too(tmp_path, text, says):
    path = tmp_path / "arm.toml"
    path.write_text(text)
    name = f"test-wrong-{os.getpid()}"
    try:
        error = CliRunner().invoke(start_command, ["--config", str(path), "--name", name]).exception
    finally:
        for part in ("", ".sock", ".lock", ".map"):
            unlink(name + part)
    assert isinstance(error, ConfigError)
    assert str(error).startswith(f"{path}: ")
    assert says in str(error)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ('name = "a/b"\n', InvalidNameError),
        ('[driver]\nkind = "simulated"\n[driver.world]\nregion = [0.0, 0.0, 1e3, 1e3]\n', RegionError),
    ],
)
def test_a_bad_name_and_a_region_too_large_name_the_file_too(tmp_path, text, error):
    path = tmp_path / "arm.toml"
    path.write_text(text)
    found = CliRunner().invoke(start_command, ["--config", str(path)]).exception
    assert isinstance(found, error)
    assert str(found).startswith(f"{path}: ")


@pytest.mark.parametrize(
    ("rounding", "follow", "expected"),
    [
        ({}, {}, "unbiased"),
        ({}, {"mode": "adaptive"}, "unbiased"),
        ({}, {"mode": "paper"}, "paper"),
        ({}, {"mode": 0}, "paper"),
        ({"rounding": "unbiased"}, {"mode": "paper"}, "unbiased"),
        ({"rounding": "paper"}, {}, "paper"),
    ],
)
def test_paper_mode_is_one_setting_the_maps_rounding_included(rounding, follow, expected):
    assert map_rounding(parse_config({"map": rounding, "follow": follow})) == expected


@pytest.mark.parametrize(
    ("section", "follow", "expected_m"),
    [
        ({}, {}, 0.0),
        ({}, {"mode": "paper", "offset": "4 in"}, pytest.approx(25.4e-6)),
        ({"quantum": "1 mm"}, {"mode": "paper"}, 1e-3),
        ({"quantum": "1 mm"}, {}, 1e-3),
    ],
)
def test_heights_have_the_papers_resolution_in_paper_mode(section, follow, expected_m):
    """0: it follows from the stand-off at each MapReset."""
    assert map_quantum_m(parse_config({"map": section, "follow": follow})) == expected_m


@pytest.mark.parametrize(
    ("follow", "close_m", "exit_m"),
    [
        ({}, 2.15 * 0.0254, 2.3 * 0.0254),
        ({"range_min": "60 mm"}, 0.060 + 0.0375 * 0.0924, 0.060 + 0.075 * 0.0924),
        ({"range_min": "30 mm", "range_max": "130 mm"}, 0.03375, 0.0375),
        ({"range_min": "60 mm", "too_close": "62 mm"}, 0.062, 0.060 + 0.075 * 0.0924),
        ({"too_close": 0.0}, 0.0, 2.3 * 0.0254),
        ({"range_max": "4 m"}, 0.0508 + 0.1 * 0.0492, 0.0508 + 0.2 * 0.0492),
        ({"offset": "3 in"}, 0.0508 + 0.1 * 0.0254, 0.0508 + 0.2 * 0.0254),
    ],
)
def test_too_close_follows_from_the_window_that_is_configured(follow, close_m, exit_m):
    params = zeros(Params)
    driver = make_driver({"kind": "simulated"}, "window")
    initialise_constants(params, parse_config({"follow": follow}), driver.info)
    assert float(params["too_close_m"][0]) == pytest.approx(close_m)
    assert float(params["too_close_exit_m"][0]) == pytest.approx(exit_m)
    in_process = Follower(follow)
    assert float(in_process._params["too_close_m"][0]) == float(params["too_close_m"][0])
    assert float(in_process._params["too_close_exit_m"][0]) == float(params["too_close_exit_m"][0])


@pytest.mark.parametrize("period", ["20 us", "0.02 ms", "1 s", "1000 ms", "1000000 us"])
def test_the_documented_bounds_of_the_period_are_accepted(period: str) -> None:
    config = parse_config({"period": period, "watchdog": "60 s"})
    assert seconds(config.period, "period", 20e-6, 1.0) in (20e-6, 1.0)


def test_a_group_is_given_by_name_or_by_number():
    group = grp.getgrgid(os.getgid())
    assert configured_group_id("", "access.group") == -1
    assert configured_group_id(group.gr_name, "access.group") == group.gr_gid
    assert configured_group_id(str(group.gr_gid), "access.group") == group.gr_gid
    with pytest.raises(ConfigError, match=r"access.group is 'no-such-group-x'"):
        configured_group_id("no-such-group-x", "access.group")
