"""Path files of plans, as tables that a test may change, and what the check finds of them."""

from __future__ import annotations

from surffollow.scan import disc
from surffollow.scan.check import check_path
from surffollow.scan.path_file import write_path
from surffollow.scan.plan import PlanSettings, plan_scan


def plan_of(tmp_path, ground, **options):
    settings = PlanSettings(
        **({"region": (0.3, 0.3, 0.9, 0.9), "gap_m": 0.05, "body_m": disc(0.08)} | options)
    )
    plan = plan_scan(ground, settings)
    file = tmp_path / "path.csv"
    write_path(file, plan)
    return plan, file


def findings_of(ground, file):
    """Findings by name."""
    return {f.name: f for f in check_path(ground.heights_m, ground.origin_m, ground.grid_m, file)}


def failed(ground, file):
    """Names of the findings that are not ok."""
    return {name for name, f in findings_of(ground, file).items() if not f.ok}


def table_of(file):
    """Lines before the table, its names, its rows."""
    lines = file.read_text().splitlines()
    head = next(k for k, line in enumerate(lines) if not line.startswith("#"))
    return lines[:head], lines[head].split(","), [line.split(",") for line in lines[head + 1 :]]


def write_table(file, facts, names, rows):
    file.write_text("\n".join([*facts, ",".join(names), *(",".join(r) for r in rows)]) + "\n")
