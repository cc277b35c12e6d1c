"""`check-robot`: the fit against a slow twin, every verdict, and the command beside a real service."""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from running_service import Service, begin_command
from second_user import as_other_user, needs_root, outcome
from surffollow.apps.fit_robot import (
    GainFit,
    count_legs,
    fit_gain,
    sensor_heights,
    white_noise_m,
)
from surffollow.apps.gain_verdict import length, units_of
from surffollow.apps.robot_check import RobotCheck
from surffollow.apps.robot_verdict import (
    ChannelFacts,
    channel_finding,
    motion_finding,
)
from surffollow.service.mount_notes import beam_tilt

LATENCY_S = 0.012
FACTS = ChannelFacts(
    readings=2000,
    invalid=0,
    outside=0,
    range_min_m=0.02,
    range_max_m=0.5,
    middle_m=0.1,
    beam_z=-1.0,
    travel_m=0.02,
    needed_m=0.01,
    latency_s=0.01,
    tau_s=0.04,
)


def up_and_down(t_s: np.ndarray, amplitude_m: float = 0.01, period_s: float = 3.0) -> np.ndarray:
    """Height over level ground [m] of a move that does not repeat itself exactly."""
    turned = 2.0 * np.pi / period_s * (t_s + 0.3 * np.sin(0.7 * t_s))
    return 0.1 + amplitude_m * np.sin(turned)


def moved(
    seed: int,
    *,
    seconds: float = 10.0,
    ratio: float = 1.0,
    noise_m: float = 5e-5,
    lag_s: float = LATENCY_S,
    period_s: float = 3.0,
    height: Callable[[np.ndarray], np.ndarray] | None = None,
) -> tuple[np.ndarray, ...]:
    """Arguments of `fit_gain` of a tool that moves up and down: 100 poses and 200 readings in 1 s."""
    random = np.random.default_rng(seed)
    truly = height or (lambda t_s: up_and_down(t_s, period_s=period_s))
    t_s = np.arange(0.0, seconds, 0.01)
    at = np.arange(0.003, seconds, 0.005)
    range_m = ratio * truly(at - lag_s) + random.normal(scale=max(noise_m, 1e-12), size=at.size)
    return t_s, truly(t_s), -np.ones_like(t_s), at, range_m


def fitted(seed: int, **options: object) -> GainFit:
    fit = fit_gain(*moved(seed, **options))  # type: ignore[arg-type]
    assert fit is not None, f"seed {seed}"
    return fit


def slow_fit(t_s, height_m, beam_z, reading_t_s, range_m) -> tuple[float, float]:
    """Gain and lag [s]: a straight line through the points, for every lag of a fine grid."""
    inside = (reading_t_s > t_s[0] + 0.5) & (reading_t_s < t_s[-1] - 0.5)
    at, r = reading_t_s[inside], range_m[inside]
    best = (np.inf, 0.0, 0.0)
    for lag in np.arange(-0.5, 0.5, 5e-4):
        p = np.interp(at - lag, t_s, height_m / np.abs(beam_z))
        gain, constant = np.polyfit(p, r, 1)
        best = min(best, (float(np.sum((r - gain * p - constant) ** 2)), float(gain), float(lag)))
    return best[1], best[2]


@pytest.mark.parametrize(("seed", "ratio", "lag_s"), [(1, 1.0, 0.012), (2, -1.0, -0.03), (3, 0.9, 0.2)])
def test_the_fit_is_that_of_its_slow_twin(seed: int, ratio: float, lag_s: float) -> None:
    data = moved(seed, ratio=ratio, lag_s=lag_s, noise_m=2e-4)
    fit = fit_gain(*data)
    gain, lag = slow_fit(*data)
    assert fit is not None
    assert fit.lag_s is not None, f"seed {seed}"
    assert fit.gain == pytest.approx(gain, abs=1e-4), f"seed {seed}"
    assert fit.lag_s == pytest.approx(lag, abs=6e-4), f"seed {seed}"
    assert fit.noise_m == pytest.approx(2e-4, rel=0.1), f"seed {seed}"


def test_standard_errors_are_those_of_the_scatter_over_seeds() -> None:
    fits = [fitted(seed, noise_m=1e-3) for seed in range(100, 130)]
    gains = np.array([f.gain for f in fits])
    lags = np.array([f.lag_s for f in fits], float)
    assert abs(gains.mean() - 1.0) < 4.0 * gains.std() / np.sqrt(30), "seeds 100 to 129"
    assert 0.6 < gains.std() / np.mean([f.gain_sigma for f in fits]) < 1.5, "seeds 100 to 129"
    assert 0.6 < lags.std() / np.mean([f.lag_sigma_s for f in fits if f.lag_sigma_s]) < 1.5, (
        "seeds 100 to 129"
    )


@pytest.mark.parametrize("seed", range(5))
def test_a_tilted_mount_that_is_right_has_the_gain_1(seed: int) -> None:
    """GIVEN any mount and attitude whose beam points downward THEN range per height along the beam is 1."""
    random = np.random.default_rng(seed)
    t_s = np.arange(0.0, 10.0, 0.01)
    poses = np.zeros((t_s.size, 7))
    poses[:, 2] = up_and_down(t_s)
    poses[:, 3:] = [*random.normal(scale=0.12, size=3), 1.0]
    poses[:, 3:] += 0.01 * np.sin(t_s)[:, None]  # the attitude wavers
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1)[:, None]
    mount = np.array([*random.normal(scale=0.02, size=3), *random.normal(scale=0.15, size=3), 1.0])
    mount[3:] /= np.linalg.norm(mount[3:])
    height_m, beam_z = sensor_heights(poses, mount)
    assert math.acos(-beam_z[0]) == pytest.approx(beam_tilt(poses[0].tolist(), tuple(mount)), abs=1e-6)
    range_m = height_m / -beam_z + random.normal(scale=2e-5, size=t_s.size)
    fit = fit_gain(t_s, height_m, beam_z, t_s, range_m)
    assert fit is not None
    assert fit.gain == pytest.approx(1.0, abs=0.01), f"seed {seed}"
    wrong = fit_gain(t_s, poses[:, 2], -np.ones_like(t_s), t_s, 1.2 * poses[:, 2])
    assert wrong is not None
    assert wrong.gain == pytest.approx(1.2), f"seed {seed}"


@pytest.mark.parametrize(
    ("seed", "ratio", "kind", "says"),
    [
        (1, 1.0, "OK", "range follows height"),
        (2, 0.97, "OK", "range follows height"),
        (3, -1.0, "reversed", "z of the world points down"),
        (4, 0.0, "no response", "but not with it"),
        (5, 0.02, "no response", "but not with it"),
        (6, 1000.0, "unit", "the ranges in mm"),
        (7, 0.001, "unit", "the heights in mm"),
        (8, 100.0, "unit", "the ranges in cm"),
        (9, 0.01, "unit", "the heights in cm"),
        (10, 39.37, "unit", "the ranges in inch"),
        (11, 0.0254, "unit", "the heights in inch"),
        (12, 3.281, "unit", "the ranges in ft"),
        (13, 0.3048, "unit", "the heights in ft"),
        (14, 25.4, "unit", "the ranges in mm and the heights in inch"),
        (15, -0.001, "unit", "the sign is reversed"),
        (16, 1.0 / math.cos(0.5), "scaled", "the beam is tilted by about 29 deg"),
        (17, 0.9, "scaled", "a tilt of about 26 deg that the beam does not have"),
        (18, -0.8, "reversed", "0.8"),
        (19, 5.0, "scaled", "expected 1"),
    ],
)
def test_every_gain_has_its_verdict(seed: int, ratio: float, kind: str, says: str) -> None:
    # the noise is in the unit of the ranges
    fit = fitted(seed, ratio=ratio, noise_m=5e-5 * (abs(ratio) or 1.0))
    found = channel_finding(fit, FACTS)
    assert (found.kind, says in found.text) == (kind, True), f"seed {seed}: {found} {fit}"
    assert bool(found.remedy) == (kind != "OK")


def test_a_unit_that_the_window_contradicts_names_both_causes() -> None:
    inside = channel_finding(fitted(1, ratio=1000.0), FACTS)
    assert "the heights are converted from mm twice" in inside.text
    outside = channel_finding(fitted(1, ratio=1000.0), ChannelFacts(**fields(middle_m=100.0)))
    assert "twice" not in outside.text


def fields(**changed: float) -> dict[str, float]:
    """Fields of `FACTS`, some of them changed."""
    return {name: getattr(FACTS, name) for name in FACTS.__struct_fields__} | changed


@pytest.mark.parametrize(
    ("changed", "kind"),
    [
        ({"readings": 0}, "no readings"),
        ({"invalid": 2000}, "no readings"),
        ({"outside": 1900, "middle_m": 0.7}, "window"),
        ({"beam_z": 1.0}, "beam"),
        ({"travel_m": 0.002}, "OK"),  # the ranges moved enough, and the fit is clear
        ({"latency_s": 0.2}, "lag"),
    ],
)
def test_other_facts_of_a_channel_have_their_verdict(changed: dict[str, float], kind: str) -> None:
    found = channel_finding(fitted(1), ChannelFacts(**fields(**changed)))  # type: ignore[arg-type]
    assert found.kind == kind, found


@pytest.mark.parametrize(("lag_s", "says"), [(0.15, "140 ms older"), (-0.08, "90 ms newer")])
def test_a_lag_beyond_the_axis_is_named(lag_s: float, says: str) -> None:
    found = channel_finding(fitted(1, lag_s=lag_s), FACTS)
    assert found.kind == "lag"
    assert says in found.text


def test_commanded_heights_lead_the_ranges_by_the_time_constant() -> None:
    t_s = np.arange(0.0, 10.0, 0.01)
    commanded = up_and_down(t_s)
    measured = commanded.copy()
    for k in range(1, t_s.size):  # an axis of the first order
        measured[k] = measured[k - 1] + (commanded[k] - measured[k - 1]) * (
            1.0 - math.exp(-0.01 / FACTS.tau_s)
        )
    at = np.arange(0.003, 10.0, 0.005)
    range_m = np.interp(at - FACTS.latency_s, t_s, measured)
    for height_m, kind in ((measured, "OK"), (commanded, "lag")):
        fit = fit_gain(t_s, height_m, -np.ones_like(t_s), at, range_m)
        assert fit is not None
        found = channel_finding(fit, FACTS)
        assert found.kind == kind, found
    assert "commanded" in found.text
    assert "measured" in found.remedy


def test_a_stuck_sensor_shows_one_value() -> None:
    t_s, height_m, beam_z, at, _ = moved(1)
    fit = fit_gain(t_s, height_m, beam_z, at, np.full(at.size, 0.1234))
    found = channel_finding(fit, FACTS)
    assert found.kind == "no response"
    assert "show one value" in found.text


def test_noise_that_hides_the_gain_is_not_enough_motion() -> None:
    found = channel_finding(fitted(1, noise_m=0.1, seconds=4.0), FACTS)
    assert found.kind == "not enough motion"
    assert "uncertain" in found.text


def test_a_sign_that_is_sure_is_reported_though_the_gain_is_uncertain() -> None:
    fit = fitted(1, noise_m=0.03, ratio=-1.0)
    assert fit.gain_sigma > 0.02
    assert channel_finding(fit, FACTS).kind == "reversed", fit


def test_little_motion_gives_no_verdict_about_the_gain() -> None:
    fit = fitted(1, height=lambda t_s: up_and_down(t_s, 0.001))
    found = channel_finding(fit, ChannelFacts(**fields(travel_m=0.002)))  # type: ignore[arg-type]
    assert found.kind == "not enough motion"


def test_a_fast_sine_cannot_tell_right_from_reversed() -> None:
    fit = fitted(1, height=lambda t_s: 0.1 + 0.01 * np.sin(2.0 * np.pi * t_s / 0.6))
    assert fit.is_ambiguous
    assert fit.lag_s is None
    assert channel_finding(fit, FACTS).kind == "ambiguous"


def test_a_steady_move_has_a_gain_and_no_lag() -> None:
    fit = fitted(1, height=lambda t_s: 0.1 + 0.002 * t_s)
    assert fit.gain == pytest.approx(1.0, abs=0.01)
    assert fit.lag_s is None


def test_readings_in_a_gap_of_the_reports_do_not_count() -> None:
    t_s, height_m, beam_z, at, range_m = moved(1)
    kept = (t_s < 4.0) | (t_s > 5.5)
    fit = fit_gain(t_s[kept], height_m[kept], beam_z[kept], at, range_m)
    assert fit is not None
    assert fit.gain == pytest.approx(1.0, abs=0.002)
    assert fit.readings < 0.8 * at.size
    assert fit_gain(t_s[:20], height_m[:20], beam_z[:20], at, range_m) is None


@pytest.mark.parametrize(
    ("arguments", "kind"),
    [
        ((0.02, 0.01, {"x": 0.001, "y": 0.0}, 500), None),
        ((0.0, 0.01, {"x": 0.0, "y": 0.0}, 0), "no poses"),
        ((0.002, 0.01, {"x": 0.0, "y": 0.0}, 500), "not enough motion"),
        ((0.02, 0.01, {"x": 0.0, "y": 0.01}, 500), "lateral"),
        ((0.0, 0.01, {"x": 0.0, "y": 0.02}, 500), "lateral"),
    ],
)
def test_a_motion_that_does_not_suit_is_named(arguments: tuple, kind: str | None) -> None:
    found = motion_finding(*arguments)
    assert (found and found.kind) == kind, found


def test_moves_up_and_down_are_counted() -> None:
    t_s = np.arange(0.0, 9.0, 0.01)
    assert count_legs(0.01 * np.cos(2.0 * np.pi * t_s / 3.0), 0.005) == 6
    assert count_legs(0.001 * np.cos(t_s), 0.005) == 0
    assert count_legs(t_s, 0.005) == 1
    assert count_legs(np.array([]), 0.005) == 0


@pytest.mark.parametrize(
    ("gain", "gain_sigma", "is_enough"), [(1.0, 0.005, True), (1.0, 0.02, False), (100.0, 0.2, True)]
)
def test_a_watch_ends_when_the_gain_is_precise_whatever_its_unit(
    monkeypatch: pytest.MonkeyPatch, gain: float, gain_sigma: float, is_enough: bool
) -> None:
    t_s = np.arange(0.0, 12.0, 0.01)
    poses = np.zeros((t_s.size, 7))
    poses[:, 2] = up_and_down(t_s)
    channel = {"gain": gain, "gain_sigma": gain_sigma, "verdict": "OK"}
    watched = RobotCheck.__new__(RobotCheck)
    monkeypatch.setattr(watched, "seconds", lambda: 12.0)
    monkeypatch.setattr(watched, "_motion", lambda: (t_s, poses, 0.01, count_legs(poses[:, 2], 0.005)))
    monkeypatch.setattr(watched, "report", lambda: {"channels": [channel]})
    assert watched.is_enough() is is_enough


@pytest.mark.parametrize("seed", range(3))
def test_the_noise_of_heights_is_found_beside_the_move(seed: int) -> None:
    t_s = np.arange(0.0, 5.0, 0.01)
    noise = np.random.default_rng(seed).normal(scale=1e-3, size=t_s.size)
    assert white_noise_m(t_s, up_and_down(t_s) + noise) == pytest.approx(1e-3, rel=0.2), f"seed {seed}"
    assert white_noise_m(t_s, up_and_down(t_s)) < 1e-5
    assert white_noise_m(10.0 * t_s, noise) == 0.0, "slow reports"


def test_the_unit_1_is_none_and_one_wrong_unit_comes_first() -> None:
    assert units_of(1.0, 0.0) is None
    assert units_of(0.1, 0.0) == ("cm", "mm")
    assert units_of(1e-3, 0.0) == ("m", "mm")
    assert [length(v) for v in (0.0, 0.02, 1.5, 19.96)] == ["0 mm", "20 mm", "1.5 m", "19.96 m"]


# ------------------------------------------------------------------ the command beside a real service

WINDOW = "range_min_m = 0.02\nrange_max_m = 0.5\nchannels = 2"


@contextlib.contextmanager
def robot(service: Service, sign: float) -> Iterator[None]:
    """A robot that moves up and down over level ground, and pushes the ranges of two sensors."""
    over = threading.Event()

    def run() -> None:
        with service.attach() as client:
            began = time.monotonic_ns()
            while not over.wait(0.005):
                t_ns = time.monotonic_ns()
                height_m = float(up_and_down(np.array(1e-9 * (t_ns - began)), period_s=1.5))
                client.ee_pos((0.0, 0.0, sign * height_m, 0.0, 0.0, 0.0, 1.0), t_ns)
                for channel in range(2):
                    client.push_range(channel, t_ns, height_m)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@pytest.mark.parametrize(("sign", "code", "verdict"), [(1.0, 0, "OK"), (-1.0, 1, "reversed")])
def test_the_command_finds_a_height_that_is_negated(
    make_service: Callable[..., Service], sign: float, code: int, verdict: str
) -> None:
    service = make_service(kind="external", driver=WINDOW).start()
    with robot(service, sign):
        done = service.run("check-robot", "--json")
    assert done.returncode == code, done.stderr
    report = json.loads(done.stdout)
    assert report["verdict"] == verdict
    assert [c["verdict"] for c in report["channels"]] == [verdict, verdict]
    for channel in report["channels"]:
        assert channel["gain"] == pytest.approx(sign, abs=0.03)
    with service.observe() as watcher:
        # the service may not have seen yet that the robot, a thread of this process, has left
        assert all(c["pid"] == os.getpid() for c in watcher.status()["clients"])
        own = {"claim_pose", "claim_range", "release_pose"}  # the last one when the robot left
        assert {e["request"] for e in watcher.audit()} <= own


def test_an_interrupt_ends_the_watch_with_a_result(make_service: Callable[..., Service]) -> None:
    service = make_service(kind="external", driver=WINDOW).start()
    with begin_command(service.command("check-robot")) as child:
        assert child.stderr is not None
        assert child.stderr.readline().startswith("Move the tool up and down by 20 mm")
        child.send_signal(signal.SIGINT)
        out, _ = child.communicate(timeout=60)
    assert child.returncode == 1
    assert "NO POSES  no pose was accepted" in out
    assert "remedy" in out


@needs_root
def test_another_user_reads_the_block_where_its_mode_allows(make_service: Callable[..., Service]) -> None:
    def reports(name: str) -> Callable[[object], str]:
        return lambda _: outcome(lambda: RobotCheck(name).report())

    closed = make_service(kind="external", driver=WINDOW).start()
    assert "NoPermissionError" in as_other_user(reports(closed.name))
    opened = make_service(kind="external", driver=WINDOW, access='board_mode = "0644"').start()
    assert as_other_user(reports(opened.name)) == "done"


def test_a_service_that_does_not_run_is_named(tmp_path: Path) -> None:
    done = Service(tmp_path).run("check-robot")
    assert done.returncode == 1
    assert "start it: surffollow start" in done.stderr


def test_the_check_imports_no_numba() -> None:
    code = "import sys, surffollow.apps.robot_check; assert 'numba' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
