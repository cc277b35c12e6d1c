"""The documents say what the program does."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from surffollow.benchmark.conditions import load_conditions
from surffollow.benchmark.followers import outside_follower
from surffollow.config.service import follow_params, parse_config
from surffollow.follower import Follower
from surffollow.map.files import EXPORTS

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[2]


def test_table_of_parameters_is_current():
    done = subprocess.run(
        [sys.executable, str(ROOT / "tools" / "write_docs.py"), "--check"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr + "; run tools/write_docs.py"


@pytest.mark.parametrize("words", [(), ("latency",), ("blocks", "watch"), ("scan", "run")])
def test_the_page_of_commands_shows_the_help_of_the_program(words: tuple[str, ...]) -> None:
    page = (ROOT / "docs/reference/cli.md").read_text()
    code = "import sys; from surffollow.cli.main import cli; cli(terminal_width=100, max_content_width=100)"
    done = subprocess.run(
        [sys.executable, "-c", code, *words, "-h"], capture_output=True, text=True, check=True
    )
    shown = done.stdout.replace("Usage: -c", "Usage: surffollow")
    assert shown in page


def test_example_configuration_is_accepted():
    text = (ROOT / "docs" / "reference" / "configuration.md").read_text()
    example = re.search(r"```toml\n(.*?)```", text, re.S)
    assert example is not None
    config = parse_config(tomllib.loads(example[1]))
    assert config.name == "surf"
    assert config.map.grids == 1_000_000


def test_every_map_format_is_described_and_how_a_geotiff_is_read():
    text = (ROOT / "docs" / "reference" / "map-file-format.md").read_text()
    table = text.split("## Other formats")[1]
    for suffix in EXPORTS[2:]:
        assert f"`{suffix}`" in table, suffix
    for word in ("scale", "offset", "unit", "coordinate system"):
        assert word in table, word


@pytest.mark.parametrize(
    "page", sorted((ROOT).glob("*.md")) + sorted((ROOT / "docs").glob("**/*.md")), ids=str
)
def test_links_between_documents_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#:]+?)(?:#[^)]*)?\)", page.read_text()):
        assert (page.parent / target).exists(), f"{page.name} links to {target}, which is not there"


@pytest.mark.parametrize(
    "page", sorted(p for p in (ROOT / "docs").glob("**/*.md") if p.parent.name != "decisions"), ids=str
)
def test_a_page_opens_with_whom_it_is_for(page):
    opening = page.read_text().split("\n\n")[1]
    assert re.match(r"This (page|tutorial) is for ", opening), opening


def test_the_index_names_every_page():
    index = (ROOT / "docs" / "index.md").read_text()
    for page in (ROOT / "docs").glob("**/*.md"):
        name = page.relative_to(ROOT / "docs").as_posix()
        assert name == "index.md" or f"({name})" in index, name


def test_every_public_part_has_a_page_of_its_docstrings():
    import surffollow

    folder = ROOT / "docs" / "reference" / "python"
    pages = " ".join(p.read_text() for p in folder.glob("*.md"))
    for part in ("", *(f".{name}" for name in (*surffollow._LIGHT, *surffollow._HEAVY))):
        assert f"<!-- api: surffollow{part} -->" in pages, part


@pytest.mark.parametrize(
    ("page", "said"),
    [
        ("reference/sonar.md", "0.1658"),
        ("explanation/maps.md", ""),
        ("how-to/embed-the-follower.md", "mm, health OK"),
    ],
)
def test_the_example_of_a_page_runs(page, said, tmp_path):
    (code, *_) = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs" / page).read_text(), re.S | re.M)
    points = "import numpy as np\npoints = np.random.default_rng(1).random((100, 3))\n"
    done = subprocess.run([sys.executable, "-c", points + code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert said in done.stdout


def blocks_of(page: str, kind: str) -> list[str]:
    """Blocks of code of a page."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    return re.findall(rf"^```{kind}\n(.*?)^```", text, re.S | re.M)


def test_the_examples_of_machines_are_configurations():
    configs = [parse_config(tomllib.loads(text)) for text in blocks_of("how-to/tune-the-follower.md", "toml")]
    assert [follow_params(c)["offset_m"] for c in configs] == [5.0, 0.004]


def test_settings_are_compared_over_the_ground_of_a_log(tmp_path, monkeypatch):
    page = "how-to/benchmark.md"
    # WHEN the profile is made of rows of a replay, one without a reading and one at the place before
    profile, settings = blocks_of(page, "python")
    (tmp_path / "make_ground.py").write_text(profile)
    rows = "".join(f"{x},{y},{z}\n" for x, y, z in ((0, 0, 1), ("", "", ""), (3, 4, 2), (3, 4, 5), (3, 5, 3)))
    (tmp_path / "rows.csv").write_text("target_x_m,target_y_m,target_z_m\n" + rows)
    words = [sys.executable, "make_ground.py", "rows.csv", "ground.csv"]
    subprocess.run(words, cwd=tmp_path, check=True, timeout=60)
    # THEN it is a surface, and plant and settings are those of a benchmark
    made = np.genfromtxt(tmp_path / "ground.csv", delimiter=",", names=True)
    assert list(zip(made["x_m"], made["height_m"])) == [(0.0, 1.0), (5.0, 2.0), (6.0, 3.0)]
    (plant,) = blocks_of(page, "toml")
    (tmp_path / "plant.toml").write_text(plant)
    conditions = load_conditions(tmp_path / "plant.toml")
    assert (conditions.standoff_m, conditions.plant.tau_s) == (5.0, 0.5)
    (tmp_path / "settings_of_a_page.py").write_text(settings)
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("quick", "calm"):
        follower = outside_follower(f"settings_of_a_page:{name}")(conditions)
        assert isinstance(follower, Follower)
        assert follower.state()["offset_m"] == 5.0


# stored words, and the table behind sf_get_param and sf_set_param
PARTS_OF_THE_HEADER = {
    "sf_load_acquire",
    "sf_load_relaxed",
    "sf_param_table",
    "sf_store_relaxed",
    "sf_store_release",
}


def test_every_result_and_the_structures_of_a_controller_are_in_the_reference():
    page = (ROOT / "docs" / "reference" / "c-api.md").read_text(encoding="utf-8")
    header = (ROOT / "include" / "surffollow.h").read_text(encoding="utf-8")
    named = r"\b(SF_(?:NO_DEMAND|NO_READING|PENDING|UNKNOWN|(?:ERR|REFUSED)_\w+)) = (-?\d+)"
    listed = {name: number for number, name in re.findall(r"^ +(-?\d+) (SF_\w+): .+", page, re.MULTILINE)}
    assert dict(re.findall(named, header)).items() <= listed.items()
    assert " -102 SF_REFUSED_BAD_VALUE: a value is not finite, out of bounds" in page
    for member in ("pose_t_ns;", "detail;", "auto_reattach;", "sf_main_thread_state ticker;", "low, high;"):
        assert member in page
    assert "slot_memory" not in page, "what is private"


def test_every_function_of_the_headers_is_in_the_reference():
    """A declaration between a comment and its function would take the comment."""
    page = (ROOT / "docs" / "reference" / "c-api.md").read_text(encoding="utf-8")
    described = set(re.findall(r"^### (\w+)", page, re.MULTILINE))
    public = r"^static inline [^;{]*?\b(sfa?_(?!i_)\w+)\([^;{]*\)\s*\{"
    for header in ("surffollow.h", "surffollow_arbiter.h"):
        text = (ROOT / "include" / header).read_text(encoding="utf-8")
        assert set(re.findall(public, text, re.MULTILINE)) - described - PARTS_OF_THE_HEADER == set()
