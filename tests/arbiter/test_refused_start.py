"""Arbiters that do not start: odd configurations, names that a live process owns."""

from __future__ import annotations

import math
import os
import subprocess
import sys

import pytest

from second_user import needs_root
from surffollow.arbiter import attach, observe
from surffollow.arbiter.config import CLIENT_NAME, parse_config
from surffollow.errors import (
    AlreadyRunningError,
    ConfigError,
    InvalidNameError,
    NotRunningError,
)
from surffollow.shm.name_lock import NameLock


@needs_root
def test_a_start_in_another_network_namespace_harms_no_server(make_arbiter):
    server = make_arbiter().start()
    words = ["unshare", "-n", sys.executable, "-m", "surffollow", "arbiter", "start", "--quiet"]
    try:
        done = subprocess.run(
            [*words, "--name", server.name, str(server.path)], capture_output=True, text=True, timeout=120
        )
    except FileNotFoundError:
        pytest.skip("no unshare on this machine")
    if "unshare" in done.stderr:
        pytest.skip(f"no network namespace here: {done.stderr.strip()}")
    assert done.returncode == 1
    assert f"process {server.process.pid}" in done.stderr
    with attach(server.name, "go") as go, observe(server.name) as seen:
        assert seen.alive()
        assert go.resource("robot").request()
    assert server.stop() == 0


@needs_root
def test_a_client_in_another_network_namespace_is_not_sent_to_start_a_second_server(make_arbiter):
    """The error was "no arbiter runs here; start it", and the start was refused because it runs."""
    server = make_arbiter().start()
    code = "import sys; from surffollow.arbiter import attach; attach(sys.argv[1], 'go', timeout_s=0.0)"
    words = ["unshare", "-n", sys.executable, "-c", code, server.name]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    except FileNotFoundError:
        pytest.skip("no unshare on this machine")
    if "unshare:" in done.stderr:
        pytest.skip(f"no network namespace here: {done.stderr.strip()}")
    assert f"runs (process {server.process.pid}), and its socket is not found here" in done.stderr
    # WHEN it has ended THEN it is to be started
    server.stop()
    with pytest.raises(NotRunningError, match="start it"):
        attach(server.name, "go", timeout_s=0.0)


def test_the_longest_name_of_a_client_is_let_in(make_arbiter):
    """One of 48 letters was cut to 47 on its way: "the configuration declares no client of that name"."""
    name = "c" * CLIENT_NAME
    server = make_arbiter(more_clients=f"{name} = 1").start()
    with attach(server.name, name) as client:
        assert client.resource("robot").request()
        assert client.holder("robot").name == name


def test_a_name_that_a_live_process_owns_is_not_taken(tmp_path):
    from surffollow.arbiter.server import Server

    name = f"own{os.getpid()}"
    own = NameLock.take(f"{name}.arbiter")
    config = parse_config({"name": name, "clients": {"a": 1}, "resources": {"r": ONE}})
    try:
        with pytest.raises(AlreadyRunningError, match=f"process {os.getpid()}"):
            Server(config)
    finally:
        own.release()


ONE = {"command": ("x",), "safe": (0.0,)}


@pytest.mark.parametrize(
    ("resources", "combine", "why"),
    [
        ({"r": ONE | {"safe": (math.inf,)}}, {}, "must be finite"),
        ({"r": ONE | {"safe": (math.nan,)}}, {}, "must be finite"),
        ({"r": ONE}, {"s": {"parts": ("r", "r")}}, "names a resource twice"),
        ({"r": ONE | {"command": ("a,b",)}}, {}, "is not allowed"),
        ({"r": ONE | {"units": ("m,s",)}}, {}, "holds a comma"),
        ({"r": ONE | {"units": ("m" * 300,)}}, {}, "more than 255"),
        ({"r": ONE | {"units": ("µ" * 200,)}}, {}, "more than 255 bytes"),
        ({"r": ONE | {"units": ("m\0s",)}}, {}, "a control character"),
        ({"r": ONE | {"command": ("x", "x"), "safe": (0.0, 0.0)}}, {}, "names a value twice"),
        ({"r": ONE | {"status": "s" * 64}}, {}, "is not allowed"),
        ({"r": ONE | {"status": "/../x y"}}, {}, "is not allowed"),
        ({"r": ONE | {"ttl": "1.5 ms"}}, {}, "ttl is '1.5 ms', less than two periods"),
        ({"r": ONE}, {"s": {"parts": ("r",), "low": (-1.0, -1.0)}}, "low holds 2 values; 1 are needed"),
        ({"r": ONE, "q": ONE | {"command": ("y",)}}, {"s": {"parts": ("r", "q")}}, "the same command"),
        ({"r": ONE, "q": ONE | {"units": ("m",)}}, {"s": {"parts": ("r", "q")}}, "the same units"),
        ({"r.lock": ONE}, {}, "that is the lock of"),
        ({"r": ONE}, {"s.map": {"parts": ("r",)}}, "that is the map of"),
    ],
)
def test_what_would_mislead_is_no_configuration(resources, combine, why):
    with pytest.raises((ConfigError, InvalidNameError), match=why):
        parse_config({"clients": {"a": 1}, "resources": resources, "combine": combine})


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ({"mode": "0666"}, "read it only"),
        ({"clients": {"c" * 48: 1}}, "has 48 letters; the most is 47"),
        ({"mode": "0660"}, "read it only"),
        ({"lease": "20 ms", "period": "15 ms"}, "lease is '20 ms', less than two periods"),
    ],
)
def test_settings_that_would_let_others_command_or_no_client_hold_are_refused(more, why):
    with pytest.raises(ConfigError, match=why):
        parse_config({"clients": {"a": 1}, "resources": {"r": ONE}} | more)
