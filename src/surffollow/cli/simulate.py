"""`surffollow simulate`: a simulated robot as a process of its own, a client like any other."""

from __future__ import annotations

import math
import signal
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from surffollow.cli.main import one_object_is_printed
from surffollow.cli.option_types import SERVICE_NAME, Finite, InputFile, OutputFile
from surffollow.cli.progress import shows_compiling
from surffollow.cli.service_notes import ServiceNotes

if TYPE_CHECKING:
    from surffollow.errors import ServiceError
    from surffollow.sim.robot_run import Service
    from surffollow.sim.standstill import Standstill


def quantity(unit: str) -> Any:
    """Option callback for a number with a unit, such as "50 mm/s"; the command gets it in SI."""

    def parse(ctx: click.Context, param: click.Parameter, value: str) -> float:
        from surffollow.units import parse_quantity

        try:
            return float(parse_quantity(value, unit, bare=True))
        except ValueError as error:
            raise click.BadParameter(str(error), ctx, param) from error

    return parse


def optional_length(ctx: click.Context, param: click.Parameter, value: str | None) -> float | None:
    """As `quantity("m")`; None where the option is not given."""
    return None if value is None else float(LENGTH(ctx, param, value))


LENGTH, SPEED, TIME = quantity("m"), quantity("m/s"), quantity("s")


@click.command("simulate")
@click.option("--name", type=SERVICE_NAME, default="surf", show_default=True, help="Service to talk to.")
@click.option(
    "--path",
    default="line",
    show_default=True,
    help="line, raster, or a CSV or NPZ file: x_m, y_m; t_s, z_m, qx qy qz qw, speed_mps, stop.",
)
@click.option("--speed", callback=SPEED, default="50 mm/s", show_default=True, help="Speed along the path.")
@click.option(
    "--seconds",
    type=Finite(min=0.0),
    default=20.0,
    show_default=True,
    help="Duration of the motion [s]; 0: to the end of the path. A first way as long as the stand-off is not "
    "scored.",
)
@click.option("--surface", default="fy91", show_default=True, help="Ground; the service needs the same.")
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=91,
    show_default=True,
    help="Seed of the ground; the service needs the same.",
)
@click.option(
    "--grid", callback=LENGTH, default="1 mm", show_default=True, help="Spacing of the ground's heights."
)
@click.option(
    "--field",
    type=Finite(),
    nargs=4,
    default=(0.0, 0.0, 2.0, 1.0),
    show_default=True,
    help="x_min y_min x_max y_max of the ground [m]; the service needs the same.",
)
@click.option(
    "--region", type=Finite(), nargs=4, default=None, help="x_min y_min x_max y_max of the path [m]."
)
@click.option("--lane", callback=LENGTH, default="20 mm", show_default=True, help="Distance of raster lanes.")
@click.option("--standoff", callback=optional_length, help="Desired stand-off [the service's own].")
@click.option("--plant", type=InputFile(streams=True), help="TOML file with the vertical axis.")
@click.option(
    "--latency", callback=TIME, default="10 ms", show_default=True, help="Delay of the pose reports."
)
@click.option(
    "--sigma",
    callback=LENGTH,
    default="0.05 mm",
    show_default=True,
    help="Standard deviation of the noise of the pose reports.",
)
@click.option("--turn", is_flag=True, help="Apply rotations, too; count along the tool's axis.")
@click.option(
    "--noise-seed", type=click.IntRange(0), default=1, show_default=True, help="Seed of that noise."
)
@click.option(
    "--wait",
    "wait_s",
    type=Finite(min=0.0),
    default=10.0,
    show_default=True,
    help="Seconds to wait for the service, and for a valid demand.",
)
@click.option("--reset-stop", is_flag=True, help="Reset a stop that is latched at the start.")
@click.option("--arbiter", type=SERVICE_NAME, help="Obey this arbiter instead of the service itself.")
@click.option("--resource", default="tool", show_default=True, help="With --arbiter: what to obey.")
@click.option("--trace", type=OutputFile(), help="Write what happened, step by step (NPZ).")
@click.option("--json", "as_json", is_flag=True, help="Print the summary as one JSON object.")
@shows_compiling
def simulate_command(
    name: str,
    path: str,
    speed: float,
    seconds: float,
    surface: str,
    seed: int,
    grid: float,
    field: tuple[float, float, float, float],
    region: tuple[float, float, float, float] | None,
    lane: float,
    standoff: float | None,
    plant: str | None,
    latency: float,
    sigma: float,
    turn: bool,
    noise_seed: int,
    wait_s: float,
    reset_stop: bool,
    arbiter: str | None,
    resource: str,
    trace: str | None,
    as_json: bool,
) -> None:
    """Simulate a robot that moves over rough ground and applies the service's demands.

    Ends when its time or its path is over, or on Ctrl-C, SIGTERM or SIGHUP, and prints how it kept its
    stand-off. Exit code 1 when it stood still for more than a tenth of the time: there was no valid demand.
    It also ends when an attached service gives no valid demand for the time of --wait, such as one that is
    stopped. The error names the status bits and the causes of the stop.
    """
    from surffollow.sim.plant import PlantConfig, load_plant
    from surffollow.sim.robot_config import RobotConfig
    from surffollow.sim.world_surface import WorldConfig

    config = RobotConfig(
        world=WorldConfig(surface=surface, seed=seed, region=field, grid_m=grid),
        path=path,
        region=region,
        speed_mps=speed,
        lane_m=lane,
        seconds=seconds,
        **({} if standoff is None else {"standoff_m": standoff}),
        report_latency_s=latency,
        report_sigma_m=sigma,
        turn=turn,
        seed=noise_seed,
        plant=load_plant(plant) if plant else PlantConfig(),
    )
    from surffollow.sim.standstill import Standstill

    def report(text: str) -> None:
        click.echo(f"surffollow: {text}", err=True)

    standstill = Standstill(name, wait_s, reset_stop, report)
    attachment = _attachment(name, arbiter, resource)
    summary = _run(config, name, wait_s, trace, attachment, standstill, standoff is None)
    error = standstill.error or _held_error(summary, name)
    _print_result(summary, as_json, error)
    one_object_is_printed(click.get_current_context())
    if error is not None:
        raise error


def _held_error(summary: dict[str, Any], name: str) -> ServiceError | None:
    from surffollow.errors import ServiceError
    from surffollow.sim.robot_run import held_too_long

    if not held_too_long(summary["ticks"], summary["held_ticks"]):
        return None
    return ServiceError(
        f"the robot stood still in {summary['held_ticks']} of its {summary['ticks']} periods: "
        f"service {name!r} gave it no valid demand"
    )


def _print_result(summary: dict[str, Any], as_json: bool, error: ServiceError | None) -> None:
    if as_json:
        import json

        click.echo(json.dumps(summary | ({} if error is None else {"error": str(error)})))
        return
    from surffollow.units import length_unit

    factor, length = length_unit(summary["standoff_m"])
    units = (("_m", length, factor, 3 if length == "mm" else 4), ("_rad", "deg", math.degrees(1.0), 3))
    for key, value in summary.items():
        if key in ("not_scored", "note"):
            continue
        for ending, unit, scale, digits in units:
            if key.endswith(ending) and key != "path_m":
                number = f"{'-':>10}" if value is None else f"{value * scale:10.{digits}f} {unit}"
                click.echo(f"{key.removesuffix(ending):24} {number}")
                break
        else:  # no error
            click.echo(f"{key:24} {value if not isinstance(value, float) else round(value, 3)!s:>10}")
    for key in ("not_scored", "note"):
        if summary[key]:
            click.echo(f"note: {summary[key]}")


class _StopSignals:
    """SIGINT, SIGTERM and SIGHUP end the preparations at once; after the first call a call reports them.

    From then on there is a block to remove: a signal interrupts nothing any more.
    """

    def __init__(self) -> None:
        self._stopped = self._asked = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> _StopSignals:
        from surffollow.shm.ending_signals import ending_signals

        for number in ending_signals():
            self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, *_: object) -> None:
        self._stopped = True
        if not self._asked:
            raise KeyboardInterrupt

    def __call__(self) -> bool:
        """Whether a signal came."""
        self._asked = True
        return self._stopped


def _attachment(name: str, arbiter: str | None, resource: str) -> Callable[[], Service]:
    from surffollow.client import attach

    if arbiter is None:
        return lambda: attach(name, label="simulated robot")
    from surffollow.apps.shared_tool import attach_arbitrated

    return lambda: attach_arbitrated(name, arbiter, resource)


def _run(
    config: Any,
    name: str,
    wait_s: float,
    trace: str | None,
    attachment: Callable[[], Service],
    standstill: Standstill,
    own_standoff: bool,
) -> dict[str, Any]:
    from surffollow.errors import RefusedError
    from surffollow.map.formats.atomic_file import check_place, replacing
    from surffollow.sim.hardware_priority import hardware_priority
    from surffollow.sim.robot_run import run_robot

    if trace:
        check_place(trace)
    notes = ServiceNotes(name)
    try:
        with hardware_priority(), _StopSignals() as stopped:
            core, summary = run_robot(
                config, name, attachment, stopped, wait_s, standstill, own_standoff, notes
            )
    except RefusedError as refused:
        if own_standoff or "offset_m" not in str(refused):
            raise
        raise RefusedError(f"--standoff {config.standoff_m:g} m: {refused}", refused.code) from None
    summary = {"standoff_m": core.config.standoff_m} | summary | {"note": notes.tau or None}
    if trace:
        import numpy as np

        with replacing(trace) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(file, **core.trace())  # type: ignore[arg-type]
    return summary
