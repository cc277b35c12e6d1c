"""The model bank without its newest sample: a wrong sample of a slow sensor is taken back.

The ground changes much between two samples of a slow sensor, so its gate is wide. A wrong sample inside it
turns the slopes of all models, and the good samples behind it are outliers. Where the next one would be none
without the newest accepted sample, that sample was wrong.
"""

from surffollow.forecast.estimation import model_bank, model_weights
from surffollow.forecast.estimation.innovation_gate import is_outlier
from surffollow.forecast.sensing.sample_hold import is_slow
from surffollow.shm.jit import jit


@jit
def take_back(params, adaptive, h_m, travel_m, way_m, moved_m, stretch):
    """Take the newest accepted sample out of the bank where the next one shows that it was wrong.

    It does where it is an outlier, and without the newest sample its innovation is less than half as great.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`earlier`, `bank` updated)
    h_m : float64       height of the next sample [m]
    travel_m : float64  distance travelled up to it [m]
    way_m, moved_m, stretch : float64  with which the bank was propagated (`model_bank.propagate_bank`)
    """
    earlier, bank = adaptive.earlier, adaptive.bank
    if earlier.kept == 0:
        return
    model_bank.propagate_bank(earlier.bank, way_m, moved_m, stretch)
    with_it_m = h_m - model_weights.blended(adaptive, bank.height_m)
    without_m = h_m - model_weights.blended(adaptive, earlier.bank.height_m)
    if abs(without_m) < 0.5 * abs(with_it_m) and is_outlier(params, adaptive, with_it_m, travel_m):
        model_bank.restore_bank(adaptive)
        earlier.kept = 0


@jit
def keep_bank(adaptive):
    """Keep the bank of a slow sensor before it is updated with a sample."""
    adaptive.earlier.kept = 1 if is_slow(adaptive) else 0
    if adaptive.earlier.kept != 0:
        adaptive.earlier.bank = adaptive.bank


@jit
def drop_bank(earlier):
    """Drop the bank: it is of another path, or of another estimate."""
    earlier.kept = 0
