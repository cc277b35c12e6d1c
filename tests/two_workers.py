"""What `make test` gives to each of its two workers: modules whole, the long ones first.

Tests of real processes mostly wait, those that compute do not: beside each other they fill two processors.
"""

from __future__ import annotations

from typing import Any

# a folder whose programs and service are shared by all of its modules
WHOLE = ("tests/cabi",)
# what lasts longest begins first, as measured one module after the other beside other work
LONG = (
    "tests/cabi",
    "tests/docs/test_tutorials.py",
    "tests/apps/test_wall_following.py",
    "tests/sonar/test_pair.py",
    "tests/map/test_files.py",
    "tests/docs/test_loop_tutorials.py",
    "tests/service/test_stop.py",
    "tests/arbiter/test_table.py",
    "tests/service/test_life.py",
    "tests/service/test_housekeeping.py",
    "tests/apps/test_shell_demo.py",
    "tests/apps/test_shared_tool.py",
    "tests/apps/test_scan_run.py",
    "tests/service/test_preview.py",
    "tests/record/test_channels.py",
    "tests/apps/test_field_demo.py",
    "tests/service/test_hostility.py",
    "tests/apps/test_demo.py",
    "tests/apps/test_demo_ends.py",
    "tests/map/test_formats.py",
    "tests/record/test_figures.py",
    "tests/forecast/test_adaptive_hazards.py",
    "tests/scan/test_paths.py",
    "tests/arbiter/test_c_client.py",
    "tests/hw/test_third_party.py",
    "tests/forecast/test_paper_twin.py",
    "tests/record/test_live_service.py",
    "tests/apps/test_scan_guard.py",
    "tests/benchmark/test_evaluation.py",
    "tests/forecast/test_tilted_tool.py",
    "tests/service/test_refused_start.py",
    "tests/client/test_light_install.py",
    "tests/scan/test_commands.py",
    "tests/forecast/test_adaptive_model_bank.py",
    "tests/docs/test_readme_loop.py",
    "tests/map/test_grids.py",
    "tests/forecast/test_adaptive_response_twin.py",
    "tests/cli/test_full_output.py",
    "tests/map/test_refocus.py",
    "tests/shm/test_python_child.py",
    "tests/service/test_access.py",
    "tests/arbiter/test_tutorial.py",
    "tests/forecast/test_adaptive_model_weights.py",
    "tests/forecast/test_paper_losses.py",
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
