"""Wrong keys of a TOML file: the errors name table, key and the nearest keys."""

from __future__ import annotations

from typing import Any

import pytest

from surffollow.arbiter.config import parse_config as parse_arbiter
from surffollow.config.service import parse_config
from surffollow.errors import ConfigError, UsageError
from surffollow.hw.registry import make_driver
from surffollow.record.columns import parse_columns
from surffollow.sim.plant import PlantConfig, from_table


@pytest.mark.parametrize(
    ("data", "text"),
    [
        ({"drivr": {}}, "key 'drivr' is unknown; did you mean 'driver'?"),
        ({"map": {"grid": 5}}, "key 'grid' of [map] is unknown; did you mean 'grids'?"),
        ({"stop": {"zzz": 5}}, "key 'zzz' of [stop] is unknown; the keys are on"),
        ({"map": {"grids": "many"}}, "key map.grids: expected int, got str"),
        ({"period": [1]}, "key period: expected "),
        ({"driver": 3}, "key driver: expected a table, got int"),
        ({"period": 1}, "watchdog is 1 s, less than 5 periods of 1 s"),
    ],
)
def test_a_wrong_key_of_a_service_is_named_with_its_table(data: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_config(data, "surf.toml")
    assert f"surf.toml: {text}" in str(caught.value).replace("configuration key watchdog", "watchdog")


def test_a_wrong_key_of_an_arbiter_is_named_with_its_table() -> None:
    with pytest.raises(ConfigError, match=r"key 'leas' is unknown; did you mean 'lease'\?"):
        parse_arbiter({"leas": "1 s"})


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"comand": ["a"]}, r"'comand' of \[resources\.robot\] is unknown.*'command'"),
        ({"command": ["a"]}, r"key 'safe' of \[resources\.robot\] is missing"),
        ({"command": ["a"], "safe": [0.0], "policy": 5}, r"key resources\.robot\.policy: expected str"),
    ],
)
def test_a_wrong_key_of_one_of_several_tables_names_the_table(wrong: dict[str, Any], text: str) -> None:
    good = {"command": ["a"], "safe": [0.0]}
    with pytest.raises(ConfigError, match=text):
        parse_arbiter({"clients": {"a": 1}, "resources": {"first": good, "robot": wrong, "last": good}})


def test_a_missing_key_of_a_driver_is_named() -> None:
    with pytest.raises(ConfigError, match=r"driver 'serial': key 'range_min_m' is missing"):
        make_driver({"kind": "serial", "port": "/dev/ttyX"}, "keys")


def test_a_word_that_is_no_choice_is_named_with_those_that_are() -> None:
    columns = {
        "time": {"column": "t", "unit": "s"},
        "range": {"column": "d", "unit": "m", "kind": "altitude"},
    }
    with pytest.raises(
        UsageError, match=r"key range\.kind: 'altitude' is no choice; it is 'range' or 'depth'"
    ):
        parse_columns(columns)


def test_a_wrong_type_in_a_plant_names_the_key() -> None:
    with pytest.raises(ConfigError, match=r"plant: key tau_s: expected float, got a list"):
        from_table({"tau_s": []}, PlantConfig, "plant")


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"kind": "udp", "prot": 5}, "driver 'udp': key 'prot' is unknown; did you mean 'port'?"),
        ({"kind": "simulated", "world": {"surfce": "flat"}}, "key 'surfce' of [world] is unknown; did you"),
        ({"kind": "serial", "bud": 1}, "driver 'serial': key 'bud' is unknown; did you mean 'baud'?"),
        ({"kind": "none", "port": 1}, "driver 'none': key 'port' is unknown; it has no keys"),
    ],
)
def test_a_wrong_key_of_a_driver_is_named_with_the_nearest_one(settings: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        make_driver(settings, "t")
    assert text in str(caught.value)
