"""`surffollow doctor` and `surffollow latency`: what they find, on machines made of files and on this one."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from surffollow.cli.doctor import doctor_command, latency_command, render
from surffollow.client.histogram_report import percentile_ns
from surffollow.errors import InputFileError, UsageError
from surffollow.service import doctor, doctor_clock, doctor_host
from surffollow.service.doctor_latency import Lateness, measure_lateness, parse_cyclictest
from surffollow.service.doctor_unit import examine_unit
from surffollow.shm.layout_board import HISTOGRAM_BINS


def tree(root: Path, **files: str) -> Path:
    for name, text in files.items():
        path = root / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n")
    return root


@pytest.mark.parametrize(
    ("version", "extra", "state", "word"),
    [
        ("#1 SMP PREEMPT_RT Debian", {}, "good", "PREEMPT_RT"),
        ("#1 SMP Debian", {"sys__kernel__realtime": "1"}, "good", "PREEMPT_RT"),
        ("#1 SMP PREEMPT_DYNAMIC", {}, "fair", "PREEMPT_DYNAMIC"),
        (
            "#1 SMP PREEMPT_DYNAMIC",
            {"sys__kernel__debug__sched__preempt": "none (voluntary) full"},
            "lacking",
            "volun",
        ),
        (
            "#1 SMP PREEMPT_DYNAMIC",
            {"sys__kernel__debug__sched__preempt": "none voluntary (full)"},
            "fair",
            "full",
        ),
        ("#1 SMP PREEMPT_DYNAMIC", {"proc__cmdline": "quiet preempt=none ro"}, "lacking", "none"),
        ("#1 SMP Debian", {}, "lacking", "does not preempt"),
    ],
)
def test_the_preemption_model_is_read_from_the_kernel(tmp_path, version, extra, state, word):
    got = doctor.check_preemption(tree(tmp_path, proc__version=f"Linux version 6.1 {version}", **extra))
    assert got.state == state
    assert word in got.found
    assert bool(got.remedy) == (state != "good")


def test_governors_isolation_throttling_clock_and_hypervisor_are_distinguished(tmp_path):
    cpu = "sys__devices__system__cpu__"
    good = tree(
        tmp_path / "good",
        **{
            f"{cpu}cpu0__cpufreq__scaling_governor": "performance",
            f"{cpu}isolated": "3",
            f"{cpu}nohz_full": "3",
            "proc__sys__kernel__sched_rt_runtime_us": "-1",
            "proc__sys__kernel__sched_rt_period_us": "1000000",
            "proc__cpuinfo": "flags\t\t: fpu sse",
            "sys__devices__system__clocksource__clocksource0__current_clocksource": "tsc",
            "dev__cpu_dma_latency": "",
        },
    )
    bad = tree(
        tmp_path / "bad",
        **{
            f"{cpu}cpu0__cpufreq__scaling_governor": "powersave",
            f"{cpu}isolated": "",
            f"{cpu}nohz_full": "(null)",
            "proc__sys__kernel__sched_rt_runtime_us": "100000",
            "proc__sys__kernel__sched_rt_period_us": "1000000",
            "proc__cpuinfo": "flags\t\t: fpu hypervisor sse",
            "sys__devices__system__clocksource__clocksource0__current_clocksource": "hpet",
        },
    )
    checks = (
        doctor.check_governor,
        doctor.check_isolation,
        doctor.check_throttling,
        doctor_clock.check_hypervisor,
        doctor_clock.check_clock,
    )
    for check in checks:
        assert check(good).state == "good", check
        worse = check(bad)
        assert worse.state in ("fair", "lacking"), check
        assert worse.remedy
    assert doctor.check_dma_latency(good).state == "good"
    assert doctor.check_dma_latency(bad).state == "unknown"
    assert doctor.check_shm(bad).state == "lacking"
    assert "10%" in doctor.check_throttling(bad).found


def test_an_empty_machine_is_unknown_not_a_crash(tmp_path):
    states = {check(tmp_path).state for check in doctor.CHECKS}
    assert states <= {"good", "fair", "lacking", "unknown"}


def test_doctor_always_ends_well_and_says_why_and_how(monkeypatch):
    monkeypatch.setattr(doctor_clock, "JITTER_S", 0.01)
    got = CliRunner().invoke(doctor_command, ["--json"], catch_exceptions=False)
    assert got.exit_code == 0
    report = json.loads(got.output)
    assert len(report["checks"]) == len(doctor.CHECKS)
    for check in report["checks"]:
        assert check["why"]
        assert check["found"]
        assert check["remedy"] or check["state"] != "lacking"
    text = CliRunner().invoke(doctor_command, [], catch_exceptions=False).output
    assert "kernel preemption" in text
    assert "lacking" in text


def test_every_deadline_is_counted_once_or_as_an_overrun():
    counts = np.zeros(HISTOGRAM_BINS, np.int64)
    begin = time.monotonic_ns()
    longest, overruns = measure_lateness(counts, 200_000, 100_000, 50)
    assert time.monotonic_ns() - begin >= 50 * 200_000
    assert counts.sum() + overruns >= 50
    assert counts.sum() <= 50
    assert percentile_ns(counts.tolist(), 1.0) >= longest * 0.999


def test_overlong_waits_skip_deadlines_and_say_how_many():
    counts = np.zeros(HISTOGRAM_BINS, np.int64)
    # a period shorter than one reading of the clock: most deadlines are missed
    longest, overruns = measure_lateness(counts, 5, 0, 10_000)
    assert overruns > 0
    assert longest >= 5
    assert 10_000 <= counts.sum() + overruns < 10_000 + longest


def test_cyclictests_histogram_is_read_with_its_overflow():
    text = "# Histogram\n000000 000000\n000012\t000090\n000100\t000009\n# Total: 000000099\n"
    text += "# Max Latencies: 25000\n# Histogram Overflows: 00001\n"
    got = parse_cyclictest(text)
    assert got.counts.sum() == 100
    assert got.longest_ns == 25_000_000
    assert percentile_ns(got.counts.tolist(), 0.5) == pytest.approx(12_500, rel=0.13)
    assert percentile_ns(got.counts.tolist(), 0.99) == pytest.approx(100_500, rel=0.13)
    assert percentile_ns(got.counts.tolist(), 1.0) == pytest.approx(25e6, rel=0.13)
    assert Lateness().summary()["wakeups"] == 0


def test_latency_measures_and_prints_percentiles_and_a_histogram():
    # in a process of its own: it locks all its memory
    line = ["latency", "--seconds", "0.05", "--runs", "2", "--no-cyclictest", "--json"]
    got = subprocess.run(
        [sys.executable, "-m", "surffollow.cli.main", *line], check=True, capture_output=True, text=True
    )
    report = json.loads(got.stdout)
    assert report["period_ns"] == 1_000_000
    ours = report["ours"]
    assert 60 <= ours["wakeups"] + ours["overruns"] <= 100 + ours["overruns"]
    assert ours["p50_ns"] <= ours["p99_ns"] <= ours["p99_9_ns"] <= ours["max_ns"]
    assert sum(b["count"] for b in ours["histogram"]) == ours["wakeups"]
    assert report["cyclictest"] is None
    assert len(report["runs"]) == 2
    text = "\n".join(render(report))
    assert "every 1 ms" in text
    assert "cyclictest  not measured" in text
    assert "#" in text


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (["--period", "1 mm"], "a time in 's'"),
        (["--period", "1 ns"], "0.00002 to 1 s"),
        (["--spin", "11 ms"], "0 to 0.01 s"),
        (["--seconds", "0"], "0.01<=x<=3600"),
        (["--runs", "0"], "1<=x<=1000"),
        (["--priority", "100"], "1<=x<=99"),
        (["--cpu", "-2"], "x>=-1"),
        (["--cpu", "99999"], "--cpu 99999 is no processor that this process may use; give one of ["),
        (["--cpu", str(10**30)], "is no processor"),
    ],
)
def test_latency_refuses_what_cannot_be(line, says):
    done = CliRunner().invoke(latency_command, line)
    refused = isinstance(done.exception, UsageError)
    assert refused or done.exit_code == 2
    assert says in (str(done.exception) if refused else done.output)


def test_help_of_latency_has_the_bounds_of_its_options():
    text = " ".join(CliRunner().invoke(latency_command, ["--help"]).output.split())
    for bounds in ("0.01<=x<=3600.0", "20 us to 1 s", "1<=x<=1000", "up to 10 ms", "1<=x<=99"):
        assert bounds in text


LOGIND = "run__systemd__system__x"


@pytest.mark.parametrize(
    ("uid", "files", "state", "found"),
    [
        (1000, {}, "good", "no systemd-logind"),
        (1000, {LOGIND: ""}, "lacking", "built-in default"),
        (999, {LOGIND: ""}, "good", "system users"),
        (
            1000,
            {LOGIND: "", "etc__systemd__logind.conf": "[Login]\nRemoveIPC=no"},
            "good",
            "no (/etc/systemd/logind",
        ),
        (1000, {LOGIND: "", "etc__systemd__logind.conf": "[Login]\n#RemoveIPC=no"}, "lacking", "default"),
        (
            1000,
            {
                LOGIND: "",
                "etc__systemd__logind.conf": "RemoveIPC=no",
                "etc__systemd__logind.conf.d__a.conf": "RemoveIPC = yes",
            },
            "lacking",
            "logind.conf.d/a.conf",
        ),
    ],
)
def test_logind_that_removes_the_objects_at_logout_is_found(tmp_path, monkeypatch, uid, files, state, found):
    monkeypatch.setattr(doctor_host.os, "geteuid", lambda: uid)
    got = doctor_host.check_remove_ipc(tree(tmp_path, **files))
    assert (got.state, found in got.found) == (state, True), got
    assert ("systemctl restart systemd-logind" in got.remedy) == (state == "lacking")


def test_interrupts_on_the_cycles_processor_are_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(doctor_host.os, "sched_getaffinity", lambda _: {0, 1, 2, 3})
    files = {
        "sys__devices__system__cpu__online": "0-3",
        "proc__irq__9__effective_affinity_list": "3",
        "proc__irq__9__smp_affinity_list": "0-3",
        "proc__irq__9__nvme__x": "",
        "proc__irq__10__effective_affinity_list": "1",
        "proc__irq__10__smp_affinity_list": "0-3",
        "proc__irq__10__eth__x": "",
        "proc__irq__11__effective_affinity_list": "3",
        "proc__irq__11__smp_affinity_list": "3",  # no driver has asked for it
    }
    got = doctor_host.check_interrupts(tree(tmp_path / "bad", **files))
    assert got.state == "lacking"
    assert "processor 3: 1 interrupts come to it, 1 more may" in got.found
    assert "echo 0,1,2 > $f" in got.remedy
    files |= {
        f"proc__irq__{n}__{f}": "0-2"
        for n in (9, 10)
        for f in ("effective_affinity_list", "smp_affinity_list")
    }
    assert doctor_host.check_interrupts(tree(tmp_path / "good", **files)).state == "good"


@pytest.mark.parametrize(
    ("text", "state"),
    [
        ("[always] madvise never", "lacking"),
        ("always [madvise] never", "good"),
        ("always madvise [never]", "good"),
    ],
)
def test_huge_pages_are_distinguished(tmp_path, text, state):
    got = doctor_host.check_huge_pages(tree(tmp_path, sys__kernel__mm__transparent_hugepage__enabled=text))
    assert got.state == state
    assert ("echo madvise" in got.remedy) == (state == "lacking")


@pytest.mark.parametrize(
    ("lines", "state"),
    [("", "good"), ("/dev/sda2 partition 1000 0 -2", "fair"), ("/f file 9 5 -2", "lacking")],
)
def test_swap_is_found(tmp_path, lines, state):
    got = doctor_host.check_swap(tree(tmp_path, proc__swaps=f"Filename Type Size Used Priority\n{lines}"))
    assert got.state == state
    assert ("swapoff -a" in got.remedy) == (state != "good")


UNIT = Path(__file__).parents[2] / "examples" / "systemd" / "surffollow.service"


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_the_example_unit_is_valid_and_shut_in_and_a_bad_one_is_not(tmp_path):
    text = UNIT.read_text().replace("/usr/local/bin/surffollow", sys.executable)
    unit = tmp_path / "surffollow.service"
    unit.write_text(text)
    got = CliRunner().invoke(doctor_command, ["--unit", str(unit), "--json"], catch_exceptions=False)
    checks = {c["name"]: c for c in json.loads(got.output)["checks"]}
    assert {n: c["state"] for n, c in checks.items()} == {"unit": "good", "exposure": "good"}, checks
    unit.write_text(
        text.replace("Restart=on-failure", "Restrat=on-failure").replace("NoNewPrivileges=yes", "")
    )
    bad = {f.name: f for f in examine_unit(unit)}
    assert bad["unit"].state == "lacking"
    assert "Restrat" in bad["unit"].found
    unit.write_text("[Service]\nExecStart=/bin/true\n")
    assert {f.name: f.state for f in examine_unit(unit)}["exposure"] == "lacking"


ABSENT = "a.service: Command /usr/local/bin/none is not executable: No such file or directory"
UNKNOWN_KEY = "a.service:25: Unknown key 'Restrat' in section [Service], ignoring."


@pytest.mark.parametrize(
    ("code", "said", "unit", "executable"),
    [
        (0, "", "valid", None),
        (1, ABSENT, "valid", ABSENT),
        (1, f"{UNKNOWN_KEY}\n{ABSENT}", UNKNOWN_KEY, ABSENT),
        (1, f"{ABSENT}\n{UNKNOWN_KEY}", UNKNOWN_KEY, ABSENT),
        (0, UNKNOWN_KEY, UNKNOWN_KEY, None),
    ],
)
def test_an_absent_program_has_its_own_reason_and_remedy(monkeypatch, code, said, unit, executable):
    monkeypatch.setattr("surffollow.service.doctor_unit.shutil.which", lambda _: "/usr/bin/systemd-analyze")
    monkeypatch.setattr("surffollow.service.doctor_unit._analyze", lambda word, *_: (code, said))
    found = {f.name: f for f in examine_unit(UNIT)}
    assert found["unit"].found == unit
    assert (found["unit"].state == "good") == (unit == "valid")
    if executable is None:
        assert "executable" not in found
        return
    assert (found["executable"].found, found["executable"].state) == (executable, "lacking")
    assert "ExecStart" in found["executable"].remedy
    assert "ignores" not in found["executable"].why


def test_a_unit_file_that_is_not_there_and_a_machine_without_systemd(tmp_path, monkeypatch):
    with pytest.raises(InputFileError, match=r"no unit file.*surffollow/systemd/surffollow\.service"):
        examine_unit(tmp_path / "none.service")
    monkeypatch.setattr("surffollow.service.doctor_unit.shutil.which", lambda _: None)
    assert {f.state for f in examine_unit(UNIT)} == {"unknown"}


def test_the_unit_asks_for_all_that_the_service_asks_the_kernel_for():
    text = UNIT.read_text()
    for line in (
        "LimitRTPRIO=99",
        "LimitMEMLOCK=infinity",
        "DeviceAllow=/dev/cpu_dma_latency rw",
        "Type=notify",
    ):
        assert f"\n{line}\n" in text
    rule = UNIT.with_name("60-surffollow.rules").read_text()
    assert 'KERNEL=="cpu_dma_latency"' in rule
    group = next(line for line in text.splitlines() if line.startswith("Group=")).partition("=")[2]
    assert f'GROUP="{group}"' in rule
