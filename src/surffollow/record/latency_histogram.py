"""The histogram of durations on the page of a recording."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.client.histogram_report import bin_edges_ns
from surffollow.record import figure as fg
from surffollow.record.figure_data import FigureData
from surffollow.units import format_ns


def draw_latency(ax: Any, data: FigureData, service: dict[str, Any] | None) -> None:
    """Shares of durations, in bins of a tenth of a decade, so that all kinds compare."""
    from matplotlib.ticker import EngFormatter, LogLocator

    o = data.rows["output"]
    delay = data.rows["pose_delay_ns"]
    seen = np.isfinite(o["range_m"][:, 0]) & (o["range_t_ns"][:, 0] > 0)
    age = (o["t_ns"] - o["range_t_ns"][:, 0])[seen]
    kinds = [
        ("pose, when it arrives", fg.BLUE, delay[delay > 0], np.ones(int((delay > 0).sum()))),
        ("distance, when it is used", fg.ORANGE, age[age > 0], np.ones(int((age > 0).sum()))),
    ]
    for name, color, label in (("lateness", fg.GREY, "wake-up"), ("execution", fg.INK, "cycle's work")):
        if service is not None and sum(service.get(name, [])):
            counts = np.array(service[name], float)
            centres = np.array([sum(bin_edges_ns(b)) / 2 for b in range(counts.size)])
            kinds.append((label, color, centres[counts > 0], counts[counts > 0]))
    for label, color, values_ns, weights in kinds:
        if values_ns.size:
            share, edges = log_histogram(values_ns, weights)
            median = float(values_ns[np.argsort(values_ns)][_middle(values_ns, weights)])
            text = f"{label}: median {format_ns(median)}"
            ax.stairs(share, edges * 1e-9, fill=True, alpha=0.6, color=color, label=text)
    ax.set(xscale="log", xlabel="age or duration", ylabel="share [%]")
    ax.xaxis.set_major_locator(LogLocator(numticks=6))  # from ns to s there is no room for every decade
    ax.xaxis.set_major_formatter(EngFormatter(unit="s"))
    ax.tick_params(axis="x", which="minor", bottom=False)
    ax.set_title("Latencies")
    ax.set_ylim(0.0, ax.get_ylim()[1] * 1.5)
    ax.set_yticks([v for v in ax.get_yticks() if v <= 100.0])
    if ax.get_legend_handles_labels()[1]:
        ax.legend(loc="upper left")


def _middle(values: NDArray[Any], weights: NDArray[np.float64]) -> int:
    """Index of the weighted median among the sorted values."""
    total = np.cumsum(weights[np.argsort(values)])
    return int(np.searchsorted(total, total[-1] / 2))


def log_histogram(
    values_ns: NDArray[Any], weights: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Shares [%] and edges [ns] of bins of a tenth of a decade."""
    at = np.floor(10.0 * np.log10(values_ns)).astype(int)
    first, last = int(at.min()), int(at.max())
    share = np.bincount(at - first, weights=weights, minlength=last - first + 1)
    return 100.0 * share / share.sum(), 10.0 ** (np.arange(first, last + 2) / 10.0)
