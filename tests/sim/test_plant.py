"""Properties of the simulated axis."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow.errors import ConfigError, InputFileError
from surffollow.sim.plant import PlantConfig, axis_step, load_plant, setpoint_for

DT_S = 1e-3


def naive_step(z: float, v: float, target: float, plant: PlantConfig) -> tuple[float, float]:
    """The same axis, said slowly."""
    p, a = 1.0 / plant.tau_s, plant.a_max_mps2
    e = target - z
    if abs(e) <= a / p**2:
        desired = p * e
    else:
        desired = math.copysign(math.sqrt(2 * a * (abs(e) - a / (2 * p**2))), e)
    for limit in (abs(e) / DT_S, plant.v_max_mps):
        desired = max(-limit, min(limit, desired))
    v += max(-a * DT_S, min(a * DT_S, desired - v))
    return z + v * DT_S, v


def run(target: float, plant: PlantConfig, steps: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    axis = np.zeros(2)
    z, v = np.empty(steps), np.empty(steps)
    for i in range(steps):
        axis_step(axis, target, plant.tau_s, plant.v_max_mps, plant.a_max_mps2, DT_S)
        z[i], v[i] = axis
    return z, v


@pytest.mark.parametrize("step_m", [1e-3, 10e-3, 30e-3, -1e-3, -10e-3, -30e-3])
@pytest.mark.parametrize("tau_s", [0.028, 0.040, 0.060])
def test_axis_reaches_a_step_without_overshoot(step_m: float, tau_s: float) -> None:
    z, _ = run(step_m, PlantConfig(tau_s=tau_s))
    assert np.max(z / step_m) <= 1.0 + 1e-9
    assert z[-1] == pytest.approx(step_m, abs=1e-9)


def test_axis_never_exceeds_its_speed_or_acceleration() -> None:
    plant = PlantConfig()
    rng = np.random.default_rng(3)
    axis, before = np.zeros(2), 0.0
    for _ in range(5000):
        axis_step(axis, rng.uniform(-0.1, 0.1), plant.tau_s, plant.v_max_mps, plant.a_max_mps2, DT_S)
        assert abs(axis[1]) <= plant.v_max_mps + 1e-12
        assert abs(axis[1] - before) <= plant.a_max_mps2 * DT_S + 1e-12
        before = axis[1]


def test_axis_equals_its_slow_twin() -> None:
    plant = PlantConfig(tau_s=0.05, v_max_mps=0.15, a_max_mps2=1.0)
    rng = np.random.default_rng(5)
    axis, z, v, target = np.zeros(2), 0.0, 0.0, 0.0
    for i in range(3000):
        if i % 10 == 0:
            target = rng.uniform(-0.02, 0.02)
        axis_step(axis, target, plant.tau_s, plant.v_max_mps, plant.a_max_mps2, DT_S)
        z, v = naive_step(z, v, target, plant)
        assert axis[0] == pytest.approx(z, abs=1e-12)
        assert axis[1] == pytest.approx(v, abs=1e-12)


def test_axis_lags_a_slow_ramp_by_its_time_constant() -> None:
    plant = PlantConfig()
    axis = np.zeros(2)
    for i in range(1000):
        axis_step(axis, 0.01 * i * DT_S, plant.tau_s, plant.v_max_mps, plant.a_max_mps2, DT_S)
    assert 0.01 * 0.999 - axis[0] == pytest.approx(0.01 * plant.tau_s, rel=0.05)


def test_setpoint_holds_the_report_when_the_demand_is_not_a_number() -> None:
    assert setpoint_for(0.1, 0.02) == pytest.approx(0.12)
    assert setpoint_for(0.1, math.nan) == 0.1
    assert setpoint_for(0.1, math.inf) == 0.1


def test_plant_file_is_read_and_a_wrong_key_or_value_is_refused(tmp_path) -> None:  # type: ignore[no-untyped-def]
    good = tmp_path / "plant.toml"
    good.write_text("tau_s = 0.028\nv_max_mps = 0.3\n")
    assert load_plant(good) == PlantConfig(tau_s=0.028, v_max_mps=0.3)
    good.write_text("[plant]\ntau_s = 0.06\n")
    assert load_plant(good).tau_s == 0.06
    # GIVEN a table of the benchmark THEN it is passed over: one file serves both
    good.write_text('tau = "28 ms"\nv_max_mps = "300 mm/s"\n[sensor]\nsigma = "0.5 mm"\n')
    assert load_plant(good) == PlantConfig(tau_s=0.028, v_max_mps=0.3)
    good.write_text("tau = 0.03\n[plant]\ntau = 0.04\n")
    with pytest.raises(ConfigError, match=r"'tau' at top level and under \[plant\]"):
        load_plant(good)
    for text in (
        "lag = 1\n",
        "tau_s = -1.0\n",
        "tau = '1 mm'\n",
        "tau_s = 'x'\n",
        "tau_s =",
        "plant = 5\n",
        "[pl]\n",
    ):
        good.write_text(text)
        with pytest.raises(ConfigError):
            load_plant(good)
    good.write_text('tau = "28 ms"\ntau_s = 0.03\n')
    with pytest.raises(ConfigError, match="'tau_s' twice, as 'tau' and as 'tau_s'"):
        load_plant(good)
    with pytest.raises(ConfigError, match="more than 16 MiB"):  # a device gives bytes without end
        load_plant("/dev/zero")
    with pytest.raises(InputFileError, match="absent"):
        load_plant(tmp_path / "absent.toml")


def test_a_plant_file_of_deeply_nested_values_is_refused(tmp_path):
    """It ended in a RecursionError."""
    (tmp_path / "deep.toml").write_text("a = " + 5000 * "[")
    with pytest.raises(ConfigError, match=r"deep\.toml is not TOML: its values are nested too deeply"):
        load_plant(tmp_path / "deep.toml")
