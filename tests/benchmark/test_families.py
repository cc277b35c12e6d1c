"""Surfaces of the families, and followers at other scales than the benchmark's."""

import numpy as np
import pytest

from surffollow.benchmark.baselines import P, run_jitted
from surffollow.benchmark.conditions import Conditions, PoseConfig, SensorConfig
from surffollow.benchmark.drive import drive
from surffollow.benchmark.families import hedges, weld
from surffollow.benchmark.family_profiles import FAMILY_SURFACES, family_names, scaled_profile
from surffollow.benchmark.methods import factory_of
from surffollow.benchmark.scene import make_scene
from surffollow.sim.plant import PlantConfig


@pytest.mark.parametrize("name", family_names())
def test_a_family_is_drawn_anew_by_seed_and_the_same_by_the_same(name):
    one, again, other = (FAMILY_SURFACES[name](seed).heights_m for seed in (1, 1, 2))
    assert (one == again).all()
    assert np.abs(one - other).max() > 1e-4
    assert np.isfinite(one).all()
    assert 1e-3 < np.ptp(one) < 0.5


def rms(scene, w):
    e = (w.z - scene.ground_m - scene.conditions.standoff_m)[scene.first_ms :]
    return float(np.sqrt(np.mean(e * e)))


SCALES = {
    "torch": (weld, 4e-3, (5e-4, 12e-3), 0.05, 500.0, 5e-5, 0.005, PlantConfig(0.03, 0.2, 4.0, 200.0), 8.0,
              {"bow_m": 8e-4, "bead_m": 6e-4, "width_m": 4e-3, "every_m": 0.05}),
    "drone": (hedges, 3.0, (0.2, 12.0), 3.0, 10.0, 0.02, 0.05, PlantConfig(0.5, 2.5, 5.0, 50.0), 40.0, {}),
}  # fmt: skip


@pytest.mark.parametrize("scale", SCALES)
def test_the_default_follower_follows_at_every_scale(scale):
    """Told window, plant and stand-off only, it is about as good as a P loop whose gain suits the case."""
    ground, standoff, (near, far), speed, hz, sigma, late, plant, seconds, sizes = SCALES[scale]
    conditions = Conditions(
        plant=plant,
        pose=PoseConfig(plant.tick_hz, 0.01, 0.2 * sigma),
        sensor=SensorConfig(hz, late, sigma, near, far, 14, 0.01, 0.3 * standoff),
        nominal_tau_s=plant.tau_s,
        standoff_m=standoff,
        unscored_m=0.1 * seconds * speed,
    )
    ratios = []
    for seed in range(3, 9):
        profile = scaled_profile(ground, seed, seconds * speed, speed * 2e-3, **sizes)
        scene = make_scene(profile, speed, seed, conditions)
        plain = []
        for gain in (0.3, 0.7, 1.3):
            s, w = scene.fresh()
            run_jitted(P, (gain,), s, w)
            plain.append(rms(scene, w))
        s, w = scene.fresh()
        drive(factory_of("ours")(conditions), s, w)
        ratios.append(rms(scene, w) / min(plain))
    assert np.exp(np.mean(np.log(ratios))) < 1.2, ratios
