"""The `surffollow` command: verbs only, each loads what it needs when it runs."""

from __future__ import annotations

import contextlib
import gc
import importlib
import io
import os
import signal
import sys
from typing import Any

import click

from surffollow.cli import old_names
from surffollow.cli.command_end import (
    NO_MEMORY,
    NO_ROOM,
    end_with_traceback,
    ending,
    json_error,
    lacks_memory,
    pipe_closed,
    print_error,
    print_unexpected,
    throw_output_away,
)
from surffollow.errors import SurffollowError, escaped
from surffollow.extras import missing_library
from surffollow.shm.ending_signals import Terminated, ended_by_signals, sent_again

# between collections of garbage: a command imports a million objects and keeps them; saves 0.1 s of a start
OBJECTS_PER_COLLECTION = 100_000

# verb → (module, click command object, what it does)
VERBS = {
    "start": ("service", "start_command", "Run the service in the foreground."),
    "stop": ("service", "stop_command", "End a service; --purge removes its kept map."),
    "status": ("status", "status_command", "Say how a service is doing."),
    "demo": ("demo", "demo_command", "Follow simulated rough ground with the real service."),
    "simulate": ("simulate", "simulate_command", "Simulate a robot that follows the service's demands."),
    "record": ("record", "record_command", "Record a service's cycles to a file."),
    "replay": ("replay", "replay_command", "Run a recording or a CSV log through the same kernels."),
    "convert": ("convert", "convert_command", "Turn recordings into tables, or into channels for viewers."),
    "recover": ("convert", "recover_command", "Rewrite what is whole of a cut recording."),
    "plot": ("plot", "plot_command", "Draw a recording, a CSV log or a map."),
    "map": ("map", "map_group", "Map files, and the map of a running service."),
    "benchmark": ("benchmark", "benchmark_command", "Compare following methods on one plant."),
    "scan": ("scan", "scan_group", "Map ground from depth images, plan a scan and check it."),
    "blocks": ("blocks", "blocks_group", "List, show, watch, record and remove shared blocks."),
    "arbiter": ("arbiter", "arbiter_group", "Share a robot among clients by priority."),
    "base": ("base", "base_command", "Simulate a mobile base with sonars."),
    "base-client": ("base", "base_client_command", "Run one client of the wall-following experiments."),
    "device": ("device", "device_command", "Simulate a camera or a speaker beside a base."),
    "wall-follow": ("base", "wall_follow_command", "Follow walls by clients that share a base."),
    "calibrate": ("calibrate", "calibrate_group", "Calibrate a sensor: range table, latency, mount."),
    "check-robot": (
        "check_robot",
        "check_robot_command",
        "Check frame, units and lag of poses and ranges.",
    ),
    "print-header": ("print_header", "print_header_command", "Print the C header of the client library."),
    "doctor": ("doctor", "doctor_command", "Say what this machine lacks for hard timing."),
    "latency": ("doctor", "latency_command", "Measure wake-up latency, beside cyclictest."),
}


AS_JSON = "surffollow.json"  # of a context: whether --json was given


class LazyGroup(click.Group):
    """A group that imports a verb's module when the verb is used; with --json an error is an object, too."""

    def make_context(self, *words: Any, **extra: Any) -> click.Context:
        """Read the options; an interrupt meanwhile is no `Abort`, whose exit code is 1."""
        try:
            return super().make_context(*words, **extra)
        except KeyboardInterrupt:
            raise click.exceptions.Exit(128 + signal.SIGINT) from None
        except BrokenPipeError:
            raise pipe_closed() from None

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        ctx.meta[AS_JSON] = "--json" in (args[: args.index("--")] if "--" in args else args)
        return super().parse_args(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the verb. The text of an error goes to stderr in any case (`main`, click)."""
        try:
            return self._invoke_until_signal(ctx)
        except (SurffollowError, click.ClickException, ModuleNotFoundError) as error:
            if ctx.meta[AS_JSON]:
                print_error(error)
            raise
        except (KeyboardInterrupt, click.Abort, Terminated) as end:
            text, code = ending(end)
            if ctx.meta[AS_JSON]:
                click.echo(json_error(text, type(end).__name__, code))
            raise click.exceptions.Exit(code) from None
        except click.exceptions.Exit:
            raise
        except BrokenPipeError:
            raise pipe_closed() from None
        except Exception as error:
            if ctx.meta[AS_JSON]:
                print_unexpected(error)
            raise

    def _invoke_until_signal(self, ctx: click.Context) -> Any:
        """Run the verb; what fails because a signal's exception was lost in C code ends by that signal."""
        with sent_again() as lost:
            try:
                return super().invoke(ctx)
            except click.exceptions.Exit:
                raise
            except Exception:
                if not lost.number:
                    raise
                if lost.number == signal.SIGINT:
                    raise KeyboardInterrupt from None
                raise Terminated(128 + lost.number) from None

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(VERBS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        name = old_names.VERBS.get(name, name)
        if name not in VERBS:
            return None
        module, attribute, _ = VERBS[name]
        return getattr(importlib.import_module(f"surffollow.cli.{module}"), attribute)  # type: ignore[no-any-return]

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, _, text) in VERBS.items()])


def one_object_is_printed(ctx: click.Context) -> None:
    """Note that the command printed its result: an error that follows goes to stderr only."""
    ctx.meta[AS_JSON] = False


def print_includedir(ctx: click.Context, param: click.Parameter, expected: bool) -> None:
    """For build scripts: `cc -I"$(surffollow --includedir)" ...`."""
    if expected:
        from pathlib import Path

        click.echo(Path(__file__).parents[1] / "include")
        ctx.exit()


def print_version(ctx: click.Context, param: click.Parameter, expected: bool) -> None:
    """As click's own option does, but also in a source tree that is not installed."""
    if expected:
        from surffollow.release import program_version

        click.echo(f"surffollow, version {program_version()}")
        ctx.exit()


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version",
    is_flag=True,
    expose_value=False,
    is_eager=True,
    callback=print_version,
    help="Show the version and exit.",
)
@click.option(
    "--includedir",
    is_flag=True,
    expose_value=False,
    is_eager=True,
    callback=print_includedir,
    help="Print the directory of surffollow.h.",
)
@click.option(
    "--owner",
    metavar="USER",
    envvar="SURFFOLLOW_OWNER",
    help="User (name or number) whose service is trusted, beside root and yourself.",
)
def cli(owner: str | None) -> None:
    """Real-time surface following, mapping and scanning for robot controllers.

    Begin with `surffollow demo`, or `surffollow start` and a program that imports
    surffollow.client. Exit codes: 0 done, 1 fault, 2 wrong usage. With --json an error is an
    object, too.
    """
    if owner:
        os.environ["SURFFOLLOW_OWNER"] = owner


def main(argv: list[str] | None = None) -> Any:
    """Entry point: errors of ours become one line and their exit code."""
    if argv is None:  # a process of its own
        gc.set_threshold(OBJECTS_PER_COLLECTION)
    for stream in (sys.stdout, sys.stderr):
        # a terminal that knows no µ gets a question mark instead of a traceback
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        try:
            # a process that a signal ends leaves no temporary file
            with contextlib.nullcontext() if argv is not None else ended_by_signals():
                return cli.main(args=argv, prog_name="surffollow", standalone_mode=True)
        finally:
            # what fails here would else fail after the last line of ours, with a traceback
            if sys.stdout is not None:
                sys.stdout.flush()
    except SurffollowError as e:
        print(f"surffollow: {escaped(str(e))}", file=sys.stderr)
        sys.exit(e.exit_code)
    except ModuleNotFoundError as e:
        remedy = missing_library(e)
        if not remedy:
            end_with_traceback()
        print(f"surffollow: {remedy}", file=sys.stderr)
        sys.exit(1)
    except (MemoryError, RuntimeError) as e:
        if not lacks_memory(e):
            end_with_traceback()
        print(f"surffollow: {NO_MEMORY}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:
        sys.exit(pipe_closed().exit_code)
    except OSError as e:
        if lacks_memory(e):
            print(f"surffollow: {NO_MEMORY}", file=sys.stderr)
            sys.exit(1)
        if e.errno not in NO_ROOM:
            end_with_traceback()
        throw_output_away()
        print(f"surffollow: cannot write the output: {e.strerror}", file=sys.stderr)
        sys.exit(1)
    except Exception:
        end_with_traceback()


if __name__ == "__main__":
    main()
