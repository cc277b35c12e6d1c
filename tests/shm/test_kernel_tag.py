"""Names of kernels' parts: types, constants in memory; kernels that are refused."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections import namedtuple
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba.core.errors import UnsupportedError

import surffollow
from surffollow.service.memory import make_cycle_memory
from surffollow.shm import jit as jit_module
from surffollow.shm.jit import jit
from surffollow.shm.kernel import types_of
from surffollow.shm.kernel_tag import HERE, tag_of

KERNEL = """
from surffollow.shm.jit import jit
from surffollow.shm.zz_constant import GAIN
@jit
def gained(x):
    return x * GAIN
@jit
def twice(x):
    return 2.0 * gained(x)
"""
LAZY = """
from surffollow.shm.jit import jit
@jit
def outer(x):
    return x
def later(x):
    from surffollow.shm.zz_kernel import gained
    return gained(x)
"""


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A copy of the package with modules of its own."""
    shutil.copytree(Path(surffollow.__file__).parent, tmp_path / "src" / "surffollow")
    shm = tmp_path / "src" / "surffollow" / "shm"
    (shm / "zz_constant.py").write_text("GAIN = 2.0\n")
    (shm / "zz_kernel.py").write_text(KERNEL)
    (shm / "zz_lazy.py").write_text(LAZY)
    return shm


def run(tree: Path, code: str, **environment: str) -> str:
    """Output of a process with the tree's package and a cache beside it."""
    own = {"PYTHONPATH": str(tree.parents[1]), "SURFFOLLOW_CACHE_DIR": str(tree.parents[2] / "cache")}
    inherited = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=inherited | own | environment, check=True, capture_output=True)
    return done.stdout.decode().strip()


TWICE = "from surffollow.shm.zz_kernel import twice; print(twice(1.0))"


def setup_class(fields: str) -> Any:
    return namedtuple("Setup", fields)  # type: ignore[misc]


def test_named_tuples_of_one_name_share_no_part() -> None:
    one, other = setup_class("near far"), setup_class("far near")

    @jit
    def near(setup: Any) -> float:
        return setup.near  # type: ignore[no-any-return]

    @jit
    def within(setups: Any) -> float:
        return near(setups[0])  # type: ignore[no-any-return]

    assert near(one(near=1.0, far=9.0)) == near(other(near=1.0, far=9.0)) == 1.0
    assert within((one(near=1.0, far=9.0),)) == within((other(near=1.0, far=9.0),)) == 1.0


def test_fields_that_change_places_change_the_tag(monkeypatch: pytest.MonkeyPatch) -> None:
    args = types_of(make_cycle_memory())

    def tag() -> str:
        return tag_of("kernel", args, {}, tag_of, True)

    before = tag()
    assert not before.startswith(HERE)
    kind = args[0].instance_class
    monkeypatch.setattr(kind, "_fields", kind._fields[::-1])
    assert tag() != before


def test_a_class_without_a_name_is_known_to_this_process_alone() -> None:
    local = setup_class("a b")
    assert tag_of("kernel", types_of(local(1, 2)), {}, tag_of, True).startswith(HERE)


def test_a_class_of_a_script_is_known_to_this_process_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    script = sys.modules["__main__"]
    monkeypatch.setattr(script, "Setup", local := setup_class("a b"), raising=False)
    local.__module__ = "__main__"
    assert tag_of("kernel", types_of(local(1, 2)), {}, tag_of, True).startswith(HERE)


def test_constants_and_defaults_in_memory_change_the_tag() -> None:
    def tag(constant: Any, default: int = 1) -> str:
        def kernel(x: int = default) -> Any:
            return constant, x

        return tag_of("kernel", (), {}, kernel, True)

    one, other = setup_class("near far"), setup_class("far near")
    constants = [1, 1.0, True, (1,), one(1, 9), other(1, 9), np.zeros(2), np.zeros(2, np.float32)]
    tags = [*map(tag, constants), tag(1, default=2)]
    assert len(set(tags)) == len(tags)
    assert tag(np.zeros(2)) == tags[6]


def test_a_constant_of_an_imported_module_changes_the_tag(monkeypatch: pytest.MonkeyPatch) -> None:
    def tag() -> str:
        def kernel() -> int:
            return jit_module.YOUNG_OBJECTS

        return tag_of("kernel", (), {}, kernel, True)

    before = tag()
    assert tag() == before
    monkeypatch.setattr(jit_module, "YOUNG_OBJECTS", 5)
    assert tag() != before


def test_code_of_a_pyc_that_is_not_the_source_is_not_kept_for_the_source(tree: Path) -> None:
    assert run(tree, TWICE) == "4.0"
    constant = tree / "zz_constant.py"
    when = constant.stat().st_mtime_ns
    constant.write_text("GAIN = 5.0\n")
    os.utime(constant, ns=(when, when))
    assert run(tree, TWICE) == "4.0", "Python itself still runs its .pyc"
    shutil.rmtree(tree / "__pycache__")
    assert run(tree, TWICE) == "10.0"


def test_a_module_that_was_edited_before_its_import_leaves_no_wrong_code(tree: Path) -> None:
    constant = str(tree / "zz_constant.py")
    edit = f"open({constant!r}, 'w').write('GAIN = 9.5\\n')"
    code = f"from surffollow.shm import zz_lazy; {edit}; print(zz_lazy.later(1.0))"
    assert run(tree, code) == "9.5"
    (tree / "zz_constant.py").write_text("GAIN = 2.0\n")
    shutil.rmtree(tree / "__pycache__")  # else of the same size and second
    assert run(tree, "from surffollow.shm import zz_lazy; print(zz_lazy.later(1.0))") == "2.0"


def test_locators_that_a_user_chose_for_numba_do_not_matter(tree: Path) -> None:
    chosen = {"NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator,InTreeCacheLocator"}
    chosen["NUMBA_CACHE_DIR"] = str(tree.parents[2] / "numba")
    assert run(tree, TWICE, **chosen) == "4.0"
    (tree / "zz_constant.py").write_text("GAIN = 5.25\n")
    assert run(tree, TWICE, **chosen) == "10.5"


def strided(a: Any, depth: int) -> Any:
    return a[1] if depth <= 0 else strided_kernel(a[::2], depth - 1)


strided_kernel = jit(strided)


@jit
def generated(n: int) -> Any:
    yield n


@jit
def ping(n: int) -> int:
    return 1 if n <= 0 else pong(n - 1)  # type: ignore[no-any-return]


@jit
def pong(n: int) -> int:
    return 2 if n <= 0 else ping(n - 1)  # type: ignore[no-any-return]


@jit
def factorial(n: int) -> int:
    return 1 if n <= 1 else n * factorial(n - 1)  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("call", "why"),
    [
        (lambda: strided_kernel(np.arange(16.0), 2), "calls itself"),
        (lambda: ping(4), "calls itself"),
        (lambda: factorial(5), "calls itself"),
        (lambda: generated(3), "generator"),
    ],
)
def test_what_cannot_be_a_kernel_is_refused(call: Callable[[], Any], why: str) -> None:
    for _ in range(2):
        with pytest.raises(UnsupportedError, match=why):
            call()
