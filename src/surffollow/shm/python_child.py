"""Commands of child processes in Python that import nothing from the working directory.

`python -m` and `python -c` look for modules in the working directory first: a file there that another user
put in would run with this process's rights.
"""

from __future__ import annotations

import sys

_NOT_FROM_HERE = "import sys\nsys.path[:] = [p for p in sys.path if p]\n"
_RUN = "import runpy\nrunpy.run_module(sys.argv.pop(1), run_name='__main__', alter_sys=True)\n"


def module_command(module: str, *words: str) -> list[str]:
    """Run as `python -m module words...` does."""
    return [sys.executable, "-c", _NOT_FROM_HERE + _RUN, module, *words]


def code_command(code: str, *words: str) -> list[str]:
    """Run as `python -c code words...` does."""
    return [sys.executable, "-c", _NOT_FROM_HERE + code, *words]
