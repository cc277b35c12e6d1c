"""Services and clients in namespaces of their own: who is who when the kernel has no number for them."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from running_service import POSE, READY_S, Service, take_pose, until
from surffollow.config import trusted_users
from surffollow.config.trusted_users import UNMAPPED_USER, own_user
from surffollow.errors import BusyError, ConfigError, RefusedError
from surffollow.shm import layout_board as lb
from surffollow.shm.trusted_folder import NUMBA_SETTINGS, check_numba_settings

Make = Callable[..., Service]
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can make such a namespace here")


def can_unshare(*words: str) -> bool:
    return subprocess.run(["unshare", *words, "true"], capture_output=True).returncode == 0


@needs_root
def test_clients_without_a_pid_are_listed_named_and_held_apart(make_service: Make) -> None:
    inside = ["unshare", "--pid", "--fork", "--kill-child", "--mount-proc"]
    if not can_unshare(*inside[1:]):
        pytest.skip("no pid namespace can be made here")
    s = make_service()
    words = [*inside, *s.start_command()]
    s.process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert s.process.stdout is not None
    assert s.process.stdout.readline().startswith("READY")
    with s.attach(label="one") as one, s.attach(label="two") as two:
        take_pose(one)
        assert {c["name"]: c["pid"] for c in one.clients()} == {"one": -1, "two": -1}
        with pytest.raises(BusyError, match="pid -1"):
            two.ee_pos(POSE)
        with pytest.raises(RefusedError, match="pid -1") as refused:
            two.set_params(max_demand=0.01)
        assert refused.value.code == lb.ERR_NOT_POSE_HOLDER
        one.set_params(max_demand=0.01)
        entry = until(lambda: [e for e in one.audit() if e["result"] == "ok"], "the entry")[-1]
        assert (entry["client"], entry["pid"]) == ("one", -1)
    said = s.run("stop")
    assert said.returncode == 1
    assert "another pid namespace" in said.stderr
    said = s.run("stop", "--purge")
    assert "stop it there" in said.stderr


@pytest.mark.parametrize(
    ("user", "mapped", "own"),
    [
        (65534, "0 0 4294967295", 65534),
        (65534, "0 100000 65536", UNMAPPED_USER),
        (65534, "", UNMAPPED_USER),
        (1000, "0 100000 65536", 1000),
        (0, "0 1000 1", 0),
    ],
)
def test_the_number_of_everybody_who_has_none_is_no_users_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, user: int, mapped: str, own: int
) -> None:
    (tmp_path / "overflowuid").write_text("65534\n")
    (tmp_path / "uid_map").write_text(mapped + "\n")
    monkeypatch.setattr(trusted_users, "_KERNEL", tmp_path / "overflowuid")
    monkeypatch.setattr(trusted_users, "_NAMESPACE", tmp_path / "uid_map")
    monkeypatch.setattr(os, "geteuid", lambda: user)
    assert own_user() == own


@needs_root
def test_in_a_user_namespace_without_a_map_no_board_is_trusted(make_service: Make) -> None:
    if not can_unshare("--user"):
        pytest.skip("no user namespace can be made here")
    s = make_service(access='board_mode = "0644"').start()
    code = (
        "import sys\nfrom surffollow.client import observe\nfrom surffollow.errors import NoPermissionError\n"
        "try:\n    print(observe(sys.argv[1]))\nexcept NoPermissionError as e:\n    print(e)"
    )
    words = ["unshare", "--user", sys.executable, "-c", code, s.name]
    done = subprocess.run(words, capture_output=True, text=True, timeout=READY_S)
    assert "belongs to user 65534, expected user 0" in done.stdout, done.stderr
    refused = subprocess.run(
        ["unshare", "--user", *s.command("start")], capture_output=True, text=True, timeout=READY_S
    )
    assert refused.returncode != 0
    assert "belongs to user 65534" in refused.stderr, "its kernel cache could be anybody's, too"


@needs_root
def test_settings_for_the_compiler_that_somebody_else_left_end_the_start(
    make_service: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    check_numba_settings()
    settings = tmp_path / NUMBA_SETTINGS
    settings.write_text("disable_jit: 1\n")
    check_numba_settings()  # one's own
    os.chown(settings, 65534, 65534)
    with pytest.raises(ConfigError, match="belongs to user 65534"):
        check_numba_settings()
    done = make_service().run("start")
    assert done.returncode == 2
    assert NUMBA_SETTINGS in done.stderr
