"""Commands of child processes in Python that import nothing from the working directory.

`python -m` and `python -c` look for modules in the working directory first: a file there that another user
put in would run with this process's rights. A child may also end with its parent, however that ends.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_NOT_FROM_HERE = "import sys\nsys.path[:] = [p for p in sys.path if p]\n"
_RUN = "import runpy\nrunpy.run_module(sys.argv.pop(1), run_name='__main__', alter_sys=True)\n"
# PR_SET_PDEATHSIG: SIGTERM when the parent dies, and an end at once when it is dead by then
_BOUND = """
import ctypes, os, sys
ctypes.CDLL(None).prctl(1, 15, 0, 0, 0)
if os.getppid() != int(sys.argv[1]):
    sys.exit(1)
from surffollow.cli.main import main
del sys.argv[1]
main()
"""
_PR_SET_PDEATHSIG = 1


def module_command(module: str, *words: str) -> list[str]:
    """Run as `python -m module words...` does."""
    return [sys.executable, "-c", _NOT_FROM_HERE + _RUN, module, *words]


def code_command(code: str, *words: str) -> list[str]:
    """Run as `python -c code words...` does."""
    return [sys.executable, "-c", _NOT_FROM_HERE + code, *words]


def bound_command(*words: str) -> list[str]:
    """Run a command of `surffollow` that ends with this process: SIGTERM when it dies."""
    return code_command(_BOUND, str(os.getpid()), *words)


def end_with_parent(parent: int) -> None:
    """SIGKILL to this process when its parent dies, an end at once when it is dead already.

    Parameters
    ----------
    parent : int
        process number of the parent
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it died before the line above
        os._exit(1)
