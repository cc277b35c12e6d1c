"""Sample hold: which conversion begins a new sample.

A sensor holds each value for a while, and the converter reads it many times.
"""

from surffollow.forecast.modes import orients
from surffollow.forecast.plant.axis_model import is_long
from surffollow.forecast.quantities import CONFIRMATION_SAMPLES, LONG_GAP_NS, QUICK_RATE, follow_interval
from surffollow.shm.jit import jit, jit_inlined
from surffollow.shm.layout_follow import CONVERSION_WINDOW

HOLD_TOLERANCE_COUNTS = 1.5  # a change of the converter's last bit is no new sample, and no new height


@jit_inlined
def new_sample(params, adaptive, sense, inputs, channel):
    """Whether a channel has a new sample, its range and timestamp.

    Conversions of a held value are one sample with the timestamp of the first of them. An unchanged value is
    a new sample once `hold_ns` have passed, in conversions 1.5 times as long.

    Parameters
    ----------
    params, adaptive, sense, inputs : records of `Params`, `AdaptiveState` (updated), `SenseState`, `Inputs`
    channel : int

    Returns
    -------
    bool, float64 [m], int64 [ns]
    """
    hold, n, hold_ns = adaptive.hold, sense.window_n[channel], params.hold_ns
    converted = inputs.n_ranges == 0  # else ranges are given to the step
    if (n if converted else sense.fresh[channel]) == 0:
        return False, 0.0, 0
    if not converted:
        value, t, flicker = sense.range_m[channel], sense.range_t_ns[channel], 0.0
        hold.readings = params.sensor_readings
    else:
        base = channel * CONVERSION_WINDOW
        newest = base + ((n - 1) & (CONVERSION_WINDOW - 1))
        value, t = sense.window_m[newest], sense.window_t_ns[newest] - params.sensor_latency_ns
        flicker, hold.readings = HOLD_TOLERANCE_COUNTS * abs(params.scale_m[channel]), 1
        # the latency is that of the middle of a held value; its first conversion is younger, at most by it
        younger_ns = min(hold_ns // 2, params.sensor_latency_ns)
        t += younger_ns
        begun_ns = params.sensor_latency_ns - younger_ns
        hold_ns += hold_ns // 2  # the begin of a held value is known to within a cycle
    if not orients(params) and sense.fresh[channel] != 0:
        observe_timestamp(adaptive, t)
    if sense.fresh[channel] != 0:
        t += hold.shift_ns
    if hold.t_ns != 0:
        if t <= hold.t_ns:
            return False, 0.0, 0
        if abs(value - hold.range_m) <= flicker:
            return t - hold.t_ns >= hold_ns, value, t
    if converted:
        for k in range(n - 2, max(0, n - CONVERSION_WINDOW) - 1, -1):
            slot = base + (k & (CONVERSION_WINDOW - 1))
            earlier, held = sense.window_t_ns[slot] - begun_ns + hold.shift_ns, sense.window_m[slot]
            # the sample before, or of a clock that jumped back since
            if abs(held - value) > flicker or not hold.t_ns < earlier <= t:
                break
            t = earlier
    return True, value, t


@jit
def observe_timestamp(adaptive, t_ns):
    """Update the correction of timestamps that went back, with a fresh sample.

    Several in a row whose timestamps lie before that of the newest sample have wrong timestamps: they follow
    each other at the usual interval until their delay is the usual one again. Where delays differ, samples
    overtake each other within twice the usual excess over the least delay.
    """
    hold, latency, usual_ns = adaptive.hold, adaptive.latency, int(adaptive.latency.delay_s * 1e9)
    delay_ns = adaptive.clock.now_ns - t_ns
    if hold.shift_ns > 0 and delay_ns < usual_ns + hold.shift_ns // 2:
        hold.shift_ns = 0
    goes_back = hold.t_ns != 0 and t_ns + hold.shift_ns < hold.t_ns
    hold.backward = hold.backward + 1 if goes_back else 0
    lasts_s, overtaken_s = hold.backward * hold.interval_s, 2.0 * (latency.delay_s - latency.least_s)
    if hold.backward >= CONFIRMATION_SAMPLES and lasts_s > overtaken_s:
        shift_ns = hold.t_ns + int(lasts_s * 1e9) - t_ns
        hold.backward = 0
        if delay_ns >= usual_ns + shift_ns // 2:
            hold.shift_ns = shift_ns


@jit
def record_sample(hold, t_ns, range_m):
    """Hold the newest sample; learn the usual interval, and the count, which is the least change of range.

    A gap that is longer than five usual intervals, or 5 s if that is more, is no interval.
    """
    change_m, gap_s = abs(range_m - hold.range_m), (t_ns - hold.t_ns) * 1e-9
    if hold.t_ns != 0 and gap_s <= 5.0 * max(hold.interval_s, LONG_GAP_NS * 1e-9):
        hold.interval_s = follow_interval(hold.interval_s, gap_s)
    if hold.t_ns != 0 and change_m > 0.0:
        hold.changes += 1
        hold.least_m = min(change_m, (1.0 + QUICK_RATE) * hold.least_m) if hold.changes > 1 else change_m
    hold.t_ns, hold.range_m = t_ns, range_m


@jit
def resolution_m(hold):
    """Count of the sensor, as far as known [m]: far below the noise unless the sensor is coarse."""
    return hold.least_m if hold.changes >= 8 else 0.0


@jit
def is_slow(adaptive):
    """Whether the sensor's interval is long for the axis: a second sample comes late."""
    return is_long(adaptive.hold.interval_s, adaptive.plant.tau_s)


@jit
def reset_hold(hold):
    """Accept a sample of any time as new."""
    hold.t_ns = hold.backward = hold.shift_ns = hold.changes = 0
