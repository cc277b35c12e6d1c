"""The controller's clock: when a demand is latched.

A plan is made for the moment at which its demand is latched. A controller latches a demand and reports its
pose in one cycle. In a service the demand published before the report is the one latched. A caller in process
takes the answer to his steps without reading. One who has no such steps takes that to the step behind his
report, or each answer: which, his reports show (`own_setpoints`).
"""

import math

from surffollow.forecast.plant.axis_model import PERIOD_S
from surffollow.forecast.quantities import MAX_GAP_NS, follow_interval
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_estimation import N_PERIODS

LATCH_DELAY_NS = 500_000  # latch time before the cycle of a service that sees the report, on average
# a controller period, in those of a plan: more frequent latches need no care; plans are too short for more
SHORTEST_PERIODS, LONGEST_PERIODS = 0.6, 3.0


@jit
def plan_call_s(adaptive):
    """Usual interval of the calls while plans are used [s]; 0: no plan needs a punctual period."""
    return adaptive.setpoint.interval_s if adaptive.preview.share > 0.0 else 0.0


@jit
def latch_time(adaptive, inputs, now_ns):
    """Time at which the controller latches its next demand [ns]; now where plans are not made ahead for it.

    Latches that come much more often than the periods of a plan need no such care. A caller in process, who
    gives ranges, latches each answer himself, unless he calls more often.
    """
    controller, call_s = adaptive.controller, plan_call_s(adaptive)
    interval_s, since_ns = controller.interval_ns * 1e-9, now_ns - controller.latched_ns
    answers_each = inputs.n_ranges > 0 and not 0.0 < call_s < 0.5 * interval_s
    plannable = SHORTEST_PERIODS * PERIOD_S < interval_s < LONGEST_PERIODS * PERIOD_S
    if not plannable or answers_each or not 0 <= since_ns < MAX_GAP_NS:
        return now_ns
    period_ns = int(controller.interval_ns)
    return now_ns + period_ns - since_ns % period_ns


@jit
def period_is_due(adaptive, inputs, now_ns):
    """Whether the demand of the next controller period has to be prepared at a time."""
    controller, interval_ns = adaptive.controller, adaptive.controller.interval_ns
    elapsed, left = now_ns - controller.period_ns, latch_time(adaptive, inputs, now_ns) - now_ns
    if left == 0:  # plans are not made ahead
        period_ns = PERIOD_S * 1e9 - 1e3  # timestamps may be rounded
        # callers are not punctual
        return elapsed >= period_ns - min(0.1 * period_ns, 0.25 * plan_call_s(adaptive) * 1e9)
    # the jerk-limited setpoint needs 7 ms for 5 mm and 12 ms for 20 mm; periods last 0.6 to 1.4 intervals
    early = left <= 0.89 * min(interval_ns, PERIOD_S * 1e9)
    prepares = controller.latch_pending == 0 and early and elapsed >= SHORTEST_PERIODS * interval_ns
    return prepares or elapsed >= (2.0 - SHORTEST_PERIODS) * interval_ns


@jit
def mean_wait_s(params, controller):
    """Mean time from a demand to its effect: half a controller period, `max_wait_s` at most [s].

    A controller reports its pose once per period.
    """
    if controller.interval_ns <= 0.0:
        return params.max_wait_s
    return min(params.max_wait_s, 0.5e-9 * controller.interval_ns)


@jit
def usual_interval(usual_ns, dt_ns):
    """Usual interval after one more [ns]; a drop-out is none."""
    return follow_interval(usual_ns, dt_ns) if 0 < dt_ns < MAX_GAP_NS else usual_ns


@jit
def observe_ask(adaptive, inputs):
    """Note a step of a caller in process without a reading: he asks for the demand that he takes.

    A reading that is due, and does not come, says nothing about that.

    Parameters
    ----------
    adaptive, inputs : records of `AdaptiveState` (`controller` updated), `Inputs`
    """
    controller, health, now_ns = adaptive.controller, adaptive.health, adaptive.clock.now_ns
    with_range = False
    for k in range(inputs.n_ranges):
        with_range = with_range or math.isfinite(inputs.given_m[k])
    if inputs.n_ranges <= 0 or with_range:
        return
    controller.asked_ns = now_ns
    since_s, interval_s = (now_ns - health.reading_ns[0]) * 1e-9, health.interval_s[0]
    if interval_s == 0.0 or since_s < 0.9 * interval_s:  # readings are not punctual
        controller.declared_ns = now_ns


@jit
def observe_latch(adaptive, inputs, reported):
    """Update the period with a latch, which ends a pending one.

    Parameters
    ----------
    adaptive, inputs : records of `AdaptiveState` (`controller` updated), `Inputs`
    reported : bool  there is a new pose report

    Returns
    -------
    bool  a caller in process who does not take each demand takes that of this cycle
    """
    controller, now_ns, in_process = adaptive.controller, adaptive.clock.now_ns, inputs.n_ranges > 0
    asked = now_ns == controller.asked_ns or (reported and now_ns - controller.asked_ns >= MAX_GAP_NS)
    if not (asked or adaptive.own.takes_each != 0 if in_process else reported):
        return False
    t_ns = now_ns if in_process else now_ns - LATCH_DELAY_NS
    controller.interval_ns = usual_interval(controller.interval_ns, t_ns - controller.latched_ns)
    controller.latched_ns = t_ns
    if controller.latch_pending != 0:
        controller.latch_ns[(controller.periods - 1) & (N_PERIODS - 1)] = t_ns
        controller.latch_pending = 0
    return in_process and asked


@jit
def begin_period(adaptive, inputs):
    """Begin a controller period now; its latch time [ns], until which its demand may change."""
    controller, now_ns = adaptive.controller, adaptive.clock.now_ns
    latch_ns = latch_time(adaptive, inputs, now_ns)
    controller.usual_ns = usual_interval(controller.usual_ns, now_ns - controller.period_ns)
    controller.period_ns = now_ns
    controller.latch_ns[controller.periods & (N_PERIODS - 1)] = latch_ns
    controller.latch_pending = 1 if latch_ns > now_ns else 0
    controller.periods += 1
    return latch_ns


@jit
def usual_periods(controller):
    """Usual time for which a demand is kept, in periods of a plan, within their limits."""
    return min(max(controller.usual_ns / (PERIOD_S * 1e9), SHORTEST_PERIODS), LONGEST_PERIODS)
