"""Resources declared as classes give the configuration that TOML gives, and the same errors."""

from __future__ import annotations

import sys

import pytest

from arbiter.arbiter_process import CONFIG
from surffollow.arbiter.config import parse_config
from surffollow.arbiter.declaration import Declaration, Value, declare
from surffollow.errors import ConfigError, InvalidNameError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

CLIENTS = {"avoid": 40, "wall": 30, "wall-2": 30, "go": 10}


class Robot(Declaration):
    speed = Value("m/s", low=-0.5, high=0.5)
    turn_rate = Value("rad/s", low=-1.0, high=1.0)
    status = "cell.base"


class Camera(Declaration):
    pan = Value()
    policy = "cooperative"
    grace = "50 ms"


class Speaker(Declaration):
    tone = Value()
    equal = "newcomer"


class Tool(Declaration):
    x, y = Value("m", low=-0.2, high=0.2), Value("m", low=-0.1, high=0.3, safe=0.1)


class PanTool(Tool):
    pan = Value("rad")


def test_classes_say_what_the_same_table_in_toml_says():
    text = CONFIG.replace("MORE_CLIENTS", "")
    in_toml = parse_config(tomllib.loads(f'name = "cell"\n{text}'))
    declared = declare("cell", CLIENTS, [Robot, Camera, Speaker])
    for config in (in_toml, declared):
        assert (config.name, config.clients, config.lease_ns) == ("cell", CLIENTS, 300_000_000)
    robot, as_toml = declared.resources["robot"], in_toml.resources["robot"]
    assert robot == as_toml
    for name in ("camera", "speaker"):
        one, other = declared.resources[name], in_toml.resources[name]
        assert (one.command, one.safe, one.policy, one.equal) == (
            other.command,
            other.safe,
            other.policy,
            other.equal,
        )


def test_what_a_class_inherits_comes_first_and_its_name_is_its_own():
    spec = declare("c", {"go": 1}, [Tool, PanTool], lease="100 ms").resources
    assert spec["tool"].safe == (0.0, 0.1)
    assert spec["pan-tool"].command == ("x", "y", "pan")
    assert spec["pan-tool"].units == ("m", "m", "rad")
    assert spec["pan-tool"].low[:2] == (-0.2, -0.1)


def test_combinations_and_options_go_through():
    class Offset(Tool):
        pass

    config = declare(
        "c",
        {"go": 1},
        [Tool, Offset],
        combine={"sum": {"parts": ("tool", "offset"), "required": ("tool",)}},
        lease="100 ms",
        history=64,
    )
    assert config.combine["sum"].required == ("tool",)
    assert (config.lease_ns, config.history) == (100_000_000, 64)


def test_wrong_declarations_are_refused_with_the_reason():
    with pytest.raises(ConfigError, match=r"has .polcy.; it must be a Value, or one of .*policy"):

        class Wrong(Declaration):
            polcy = "fence"

    class Unsafe(Declaration):
        x = Value(safe=2.0, high=1.0)

    class Twin(Robot):
        resource = "robot"

    with pytest.raises(ConfigError, match=r"declaration of arbiter 'c'.*safe\[0\] is 2, outside"):
        declare("c", {"go": 1}, [Unsafe])
    with pytest.raises(ConfigError, match="two resources are called 'robot'"):
        declare("c", {"go": 1}, [Robot, Twin])
    with pytest.raises(ConfigError, match="must be 1 to"):
        declare("c", {"go": 1}, [])
    with pytest.raises((ConfigError, InvalidNameError)):
        declare("no/name", {"go": 1}, [Robot])
    with pytest.raises(ConfigError, match="leese"):
        declare("c", {"go": 1}, [Robot], leese="100 ms")
