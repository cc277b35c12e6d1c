"""`surffollow start`, `stop` and `status`."""

from __future__ import annotations

import os
import resource
import sys

import click

from surffollow.cli.ending import check_holder_is_here, end_process
from surffollow.cli.entry import EndedAtOnceByInterrupts
from surffollow.cli.option_types import JSON, SERVICE_NAME, Finite, InputFile
from surffollow.errors import FaultError

LEAST_ADDRESS_SPACE = 700_000_000  # of a start with compiled kernels [bytes]: it works with 635 MB


def check_address_space() -> None:
    """Refuse a limit of address space that is too small, before NumPy loads: OpenBLAS ends or spins there.

    Under a larger limit OpenBLAS gets one thread, because each takes address space.

    Raises
    ------
    FaultError
        the limit of this process is too small for a service
    """
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY:
        return
    if limit < LEAST_ADDRESS_SPACE:
        raise FaultError(
            f"the address space of this process is limited to {limit // 1000000} MB; a service needs 1 GB: "
            "raise the limit (ulimit -v, LimitAS=)"
        )
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


@click.command("start")
@click.option(
    "--config",
    "config_path",
    type=InputFile(streams=True),
    help="TOML file; see docs/reference/configuration.md.",
)
@click.option("--name", type=SERVICE_NAME, help="Name of the service and its shared-memory objects [surf].")
@click.option("--quiet", is_flag=True, help="Print only READY, errors and the audit trail.")
@click.option(
    "--strict", is_flag=True, help="Refuse to start without real-time priority, locked memory, processor."
)
def start_command(config_path: str | None, name: str | None, quiet: bool, strict: bool) -> None:
    """Run the service in the foreground: prints READY when robots may attach.

    SIGTERM, SIGHUP and Ctrl-C end it.
    """
    check_address_space()
    with EndedAtOnceByInterrupts():
        from surffollow.service.messages import hold_standard_files

        hold_standard_files()
        import msgspec

        from surffollow.config.input_file import contents_are_read
        from surffollow.config.names import check_service_name
        from surffollow.config.service import ServiceConfig, load_config
        from surffollow.errors import InputFileError, UsageError
        from surffollow.shm.trusted_folder import check_numba_settings

        config = load_config(config_path) if config_path else ServiceConfig()
        if name is not None:
            config = msgspec.structs.replace(config, name=name)
        if strict:
            config = msgspec.structs.replace(
                config, realtime=msgspec.structs.replace(config.realtime, strict=True)
            )
        with contents_are_read():  # NAME was checked
            check_service_name(config.name)
        check_numba_settings()
        from surffollow.service.daemon import serve

    try:
        serve(config, quiet)
    except KeyboardInterrupt:  # before the service had objects to tidy up
        sys.exit(130)
    except (InputFileError, UsageError) as error:  # no such calibration; a region too large
        with contents_are_read():
            if config_path is None or str(error).startswith(config_path):
                raise
            raise type(error)(f"{config_path}: {error}") from None


@click.command("stop")
@click.option("--name", type=SERVICE_NAME, default="surf", show_default=True, help="Name of the service.")
@click.option("--purge", is_flag=True, help="Also remove the kept map; a latched stop is kept.")
@click.option(
    "--timeout", type=Finite(min=0.0), default=10.0, show_default=True, help="Seconds to wait for its end."
)
@JSON
def stop_command(name: str, purge: bool, timeout: float, as_json: bool) -> None:
    """End a service in good order; its map is kept for the next start unless --purge is given.

    A latched stop outlives a purge. So does, where a client held the pose or the service was killed, the mark
    that stops a start with other parameters. A latched stop that is kept, with or without a purge, is named,
    and "stop_kept" of --json is true.
    """
    from surffollow.errors import NotRunningError

    pid, purged, stop_kept = running_pid(name), False, ""
    if pid:
        end_process(pid, lambda: running_pid(name), f"service {name!r}", timeout)
    if purge:
        purged, stop_kept = purge_leftovers(name)
        if not pid and not purged:
            raise NotRunningError(f"no service {name!r} runs and no map of that name is kept{stop_kept}")
        if stop_kept:
            print(f"the map of {name!r} is removed{stop_kept}", file=sys.stderr)
    elif not pid:
        check_holder_is_here(name, f"service {name!r}")
        raise NotRunningError(f"no service {name!r} is running")
    else:
        stop_kept = kept_for_next_start(name)
        if stop_kept:
            print(f"{name!r} has ended{stop_kept}", file=sys.stderr)
    if as_json:
        import json

        print(json.dumps({"name": name, "pid": pid or None, "purged": purged, "stop_kept": bool(stop_kept)}))


def running_pid(name: str) -> int:
    """The pid of the live process that holds a service's name; 0 when there is none."""
    from surffollow.errors import InvalidNameError
    from surffollow.service.stale_objects import board_owner, is_block
    from surffollow.shm.name_lock import holder

    pid = holder(name)
    if pid > 0 and is_block(name):
        raise InvalidNameError(
            f"{name!r} is a block of a program (pid {pid}), no service; end that program by its own means "
            "(surffollow blocks ls)"
        )
    # another user's lock cannot be looked at, and a lock may have been removed manually: the board decides
    return pid if pid > 0 else board_owner(name)


def purge_leftovers(name: str) -> tuple[bool, str]:
    """Remove the map and what a killed service left; whether there was any, and what is said of a stop."""
    from surffollow.config.trusted_users import own_user
    from surffollow.service.kept_stop import NOTHING, kept_stop_owner
    from surffollow.service.name_owner import purge_map

    removed, stop = purge_map(name)
    if stop == NOTHING:
        return removed, ""
    owner = kept_stop_owner(name)
    whose = "" if owner == own_user() else f" by user {owner}"
    return removed, (
        f"; {stop.text()} is kept for the next start{whose}: the pose's holder resets it there "
        f"(reset_stop(), in C sf_stop_reset), or remove /dev/shm/{name}.stop when no robot follows that "
        "service"
    )


def kept_for_next_start(name: str) -> str:
    """Text about a latched stop that outlives a service which has ended; empty: there is none."""
    from surffollow.errors import BlockError
    from surffollow.service.kept_stop import stop_of_next_start

    try:
        stop = stop_of_next_start(name)
    except BlockError:  # the next start says what stands there
        return ""
    if not stop.causes:
        return ""
    return (
        f"; {stop.text()} is kept for the next start: the pose's holder resets it there (reset_stop(), in C "
        "sf_stop_reset)"
    )
