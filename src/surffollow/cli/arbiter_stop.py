"""`surffollow arbiter stop`."""

from __future__ import annotations

import json

import click

from surffollow.cli.ending import check_holder_is_here, end_process
from surffollow.cli.option_types import JSON, SERVICE_NAME, Finite


@click.command("stop")
@click.option("--name", type=SERVICE_NAME, default="cell", show_default=True, help="Name of the arbiter.")
@click.option("--purge", is_flag=True, help="Also remove what it left, and so forget lost parts of sums.")
@click.option(
    "--timeout", type=Finite(min=0.0), default=10.0, show_default=True, help="Seconds to wait for its end."
)
@JSON
def stop_command(name: str, purge: bool, timeout: float, as_json: bool) -> None:
    """End an arbiter in good order; its resources get their safe command, and it removes its objects.

    A killed one leaves its board and command blocks. The next start replaces them, and --purge removes them.
    The board also stays when a part of a sum is lost, which the next server finds there.
    """
    from surffollow.arbiter.name_owner import purge_arbiter, server_pid
    from surffollow.errors import NotRunningError

    pid, removed = server_pid(name), list[str]()
    if pid:
        end_process(pid, lambda: server_pid(name), f"arbiter {name!r}", timeout)
    else:
        check_holder_is_here(f"{name}.arbiter", f"arbiter {name!r}")
    if purge:
        removed = purge_arbiter(name)
    if not pid and not removed:
        left = " and none left anything" if purge else "; --purge removes what a killed one left"
        raise NotRunningError(f"no arbiter {name!r} is running{left}")
    if as_json:
        print(json.dumps({"name": name, "pid": pid or None, "removed": removed}))
