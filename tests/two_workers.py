"""Scheduler of `make test`: each worker gets whole modules, the long ones first.

Tests of real processes mostly wait, those that compute do not: four workers fill two processors.
"""

from __future__ import annotations

from typing import Any

# a folder whose programs and service are shared by all of its modules
WHOLE = ("tests/cabi",)
# the longest module starts first; durations measured one module after the other beside other work
LONG = (
    "tests/cabi",
    "tests/docs/test_tutorials.py",
    "tests/apps/test_field_demo.py",
    "tests/docs/test_loop_tutorials.py",
    "tests/service/test_housekeeping.py",
    "tests/service/test_log_lines.py",
    "tests/examples/test_controllers.py",
    "tests/apps/test_wall_following.py",
    "tests/apps/test_scan_run.py",
    "tests/service/test_life.py",
    "tests/service/test_hostility.py",
    "tests/record/test_figures.py",
    "tests/map/test_formats.py",
    "tests/apps/test_shell_demo.py",
    "tests/apps/test_shared_tool.py",
    "tests/apps/test_demo_ends.py",
    "tests/service/test_death.py",
    "tests/arbiter/test_c_client.py",
    "tests/forecast/test_adaptive_hazards.py",
    "tests/apps/test_demo.py",
    "tests/forecast/test_paper_losses.py",
    "tests/scan/test_paths.py",
    "tests/service/test_preview.py",
    "tests/examples/test_rust.py",
    "tests/forecast/test_paper_twin.py",
    "tests/record/test_replay.py",
    "tests/hw/test_third_party.py",
    "tests/forecast/test_adaptive_stages.py",
    "tests/blocks/test_deaths.py",
    "tests/sim/test_simulate_command.py",
    "tests/sim/test_shell_following.py",
    "tests/service/test_refused_start.py",
    "tests/scan/test_held_out.py",
    "tests/map/test_files.py",
    "tests/forecast/test_tilted_tool.py",
    "tests/benchmark/test_baselines.py",
    "tests/arbiter/test_tutorial.py",
    "tests/apps/test_clearance_monitor.py",
    "tests/forecast/test_adaptive_extrapolation.py",
    "tests/service/test_access.py",
    "tests/client/test_light_install.py",
    "tests/benchmark/test_evaluation.py",
    "tests/cli/test_full_output.py",
    "tests/map/test_refocus.py",
    "tests/test_follower.py",
)


def unit(nodeid: str) -> str:
    """The module or folder that a test stays in, with its fixtures."""
    module = nodeid.split("::")[0]
    return next((folder for folder in WHOLE if module.startswith(folder + "/")), module)


def turn(name: str) -> tuple[int, str]:
    """When a unit begins."""
    return (LONG.index(name) if name in LONG else len(LONG)), name


def make_scheduler(config: Any, log: Any) -> Any:
    """The scheduler of pytest-xdist that hands out those units."""
    from xdist.scheduler import LoadScopeScheduling

    class ByUnit(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return unit(nodeid)

        def _assign_work_unit(self, node: Any) -> None:
            self.workqueue.move_to_end(min(self.workqueue, key=turn), last=False)
            super()._assign_work_unit(node)

    return ByUnit(config, log)
