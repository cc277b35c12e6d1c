"""Draw how the paper's stored mean freezes: docs/explanation/rounding.png, or the path given."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from surffollow.map.kernels.grids import blended, dither_at, dither_rotation

QUANTUM_MM = 0.0254
PICTURE = Path(__file__).parents[1] / "docs" / "explanation" / "rounding.png"


def stored(samples: np.ndarray, paper: bool, seed: int = 91) -> np.ndarray:
    """The stored mean after each sample, in quanta."""
    means = np.empty(samples.size)
    mean = count = 0
    for n, z in enumerate(samples):
        u = dither_at(dither_rotation(np.uint64(seed), n >> 6), n)
        mean = blended(mean, count, float(z), paper, u)
        count = min(count + 1, 255)
        means[n] = mean
    return means


def exact(samples: np.ndarray) -> np.ndarray:
    """The same mean without rounding."""
    means, mean = np.empty(samples.size), 0.0
    for n, z in enumerate(samples):
        mean += (z - mean) / (min(n, 255) + 1)
        means[n] = mean
    return means


def main() -> None:
    """Two cases: ground that sank by 2.5 mm, and the same seen through a noisy sensor that drifts."""
    rng = np.random.default_rng(91)
    step = np.repeat([100.0, 100.0 + 2.5 / QUANTUM_MM], [255, 1745])
    ramp = (
        100.0 + np.clip(np.arange(4000) - 255, 0, None) * (3.0 / QUANTUM_MM / 3745) + rng.normal(0, 10, 4000)
    )
    figure = Figure(figsize=(10, 4), layout="constrained")
    FigureCanvasAgg(figure)
    cases = ((step, "a step of 2.5 mm after 255 samples"), (ramp, "a rise of 3 mm, noise 0.25 mm"))
    for axes, (samples, title) in zip(figure.subplots(1, 2), cases):
        n = np.arange(1, samples.size + 1)
        base = 100.0
        axes.plot(n, (exact(samples) - base) * QUANTUM_MM, color="0.6", lw=4, label="without rounding")
        axes.plot(
            n,
            (stored(samples, False) - base) * QUANTUM_MM,
            color="tab:blue",
            lw=1.2,
            label="unbiased (default)",
        )
        axes.plot(
            n,
            (stored(samples, True) - base) * QUANTUM_MM,
            color="tab:red",
            lw=1.2,
            label="to nearest (paper)",
        )
        axes.axvline(255, color="0.8", lw=0.8)
        axes.set_title(title)
        axes.set_xlabel("samples in the grid")
        axes.set_ylabel("stored mean [mm]")
        axes.grid(alpha=0.3)
    figure.axes[0].legend(loc="center right")
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else PICTURE
    figure.savefig(target, dpi=90)
    print(f"{target}: {target.stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    main()
