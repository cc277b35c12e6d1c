"""What `make test` gives to each of its two workers: modules whole, the long ones first.

Tests of real processes mostly wait, those that compute do not: beside each other they fill two processors.
"""

from __future__ import annotations

from typing import Any

# a folder whose programs and service are shared by all of its modules
WHOLE = ("tests/cabi",)
# what compiles or lasts longest begins first, seconds with a warm kernel cache
LONG = (
    "tests/cabi",
    "tests/apps/test_demo_ends.py",
    "tests/apps/test_shell_demo.py",
    "tests/apps/test_scan_run.py",
    "tests/service/test_preview.py",
    "tests/service/test_hostility.py",
    "tests/apps/test_demo.py",
    "tests/record/test_live_service.py",
    "tests/service/test_life.py",
    "tests/record/test_log_kernels.py",
    "tests/benchmark/test_acceptance.py",
    "tests/service/test_death.py",
    "tests/service/test_impostors.py",
    "tests/map_live/test_install.py",
    "tests/service/test_outlived.py",
    "tests/forecast/test_paper_twin.py",
    "tests/map/test_grids.py",
    "tests/service/test_access.py",
    "tests/map_live/test_install_waits.py",
    "tests/sim/test_shell_following.py",
    "tests/benchmark/test_evaluation.py",
    "tests/cli/test_full_output.py",
    "tests/service/test_many_clients.py",
    "tests/blocks/test_deaths.py",
    "tests/sim/test_simulate_command.py",
    "tests/map/test_files.py",
    "tests/map_live/test_reading.py",
    "tests/map/test_refocus.py",
    "tests/map/test_preview_line.py",
    "tests/client/test_demand_into.py",
    "tests/service/test_threads.py",
    "tests/record/test_replay.py",
    "tests/map_live/test_cut_off.py",
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
