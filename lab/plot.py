"""Pictures of the results, where matplotlib (the extra "bench") is installed."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any, Final

from lab.samples import percentile

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    Series = Mapping[str, Sequence[float]]
    Panel = Any  # matplotlib's, which is not loaded here

_TICKS: Final = (50.0, 90.0, 99.0, 99.9, 99.99)


def path(image: Path, series: Mapping[tuple[str, int], Sequence[float]], titles: Mapping[str, str]) -> bool:
    """Draw the distribution of one-way latencies (µs) by contender, one panel a size; return whether it was drawn."""
    sizes = sorted({size for _, size in series})
    panels = {f"{size} B": {title: series.get((key, size), ()) for key, title in titles.items()} for size in sizes}
    return shares(image, panels, "one way, µs")


def shares(image: Path, panels: Mapping[str, Series], unit: str) -> bool:
    """Draw how large a share of the samples is at most so large; return whether it was drawn."""

    def draw(panel: Panel, title: str, samples: Sequence[float]) -> None:
        values = sorted(samples)
        panel.plot(values, [(i + 1) / len(values) for i in range(len(values))], label=title, linewidth=1.2)
        panel.set_xscale("log")
        panel.set_xlim(left=1.0)
        panel.set_xlabel(unit)

    return _draw(image, panels, draw, "share of messages at most this much")


def tails(image: Path, panels: Mapping[str, Series], unit: str, limit: float | None = None) -> bool:
    """Draw each percentile up to what the samples carry, the rare ones stretched; return whether it was drawn.

    Args:
        image: The file.
        panels: Samples by line, by panel.
        unit: What they are.
        limit: Where a line says what is to be reached.
    """

    def draw(panel: Panel, title: str, samples: Sequence[float]) -> None:
        values = sorted(samples)
        ranks = [100 - 100 * 10 ** (-step / 20) for step in range(1, 101) if len(values) * 10 ** (-step / 20) >= 10]
        if not ranks:  # too few
            return
        rarity = [1 / (1 - rank / 100) for rank in ranks]
        panel.plot(rarity, [percentile(values, rank) for rank in ranks], label=title, linewidth=1.2)
        panel.set_xscale("log")
        panel.set_yscale("log")
        panel.set_xticks([1 / (1 - tick / 100) for tick in _TICKS], [f"p{tick:g}" for tick in _TICKS])
        if limit:
            panel.axhline(limit, color="black", linestyle=":", linewidth=0.8)

    return _draw(image, panels, draw, unit)


def bars(image: Path, panels: Mapping[str, Mapping[str, float]], unit: str) -> bool:
    """Draw one bar a line side by side; return whether it was drawn."""

    def draw(panel: Panel, title: str, samples: Sequence[float]) -> None:
        panel.bar([len(panel.containers)], samples, label=title)
        panel.set_xticks([])

    one_each = {name: {title: [value] for title, value in series.items()} for name, series in panels.items()}
    return _draw(image, one_each, draw, unit)


def lines(image: Path, panels: Mapping[str, Mapping[str, Sequence[tuple[float, float]]]], unit: str) -> bool:
    """Draw figures over what grows, from points of (how much, figure); return whether it was drawn."""

    def draw(panel: Panel, title: str, samples: Sequence[float]) -> None:
        panel.plot(samples[::2], samples[1::2], marker="o", label=title, linewidth=1.2)
        panel.set_xscale("log")
        panel.set_xticks(samples[::2], [f"{step:g}" for step in samples[::2]])
        panel.minorticks_off()
        panel.set_ylim(bottom=0.0, auto=True)  # the next line may be higher

    flat = {
        name: {title: [*itertools.chain(*points)] for title, points in series.items()}
        for name, series in panels.items()
    }
    return _draw(image, flat, draw, unit)


def _draw(
    image: Path, panels: Mapping[str, Series], draw: Callable[[Panel, str, Sequence[float]], None], unit: str
) -> bool:
    try:
        import matplotlib as mpl
    except ImportError:
        return False
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(
        1, len(panels), figsize=(min(6.0, 3 + 6 / len(panels)) * len(panels), 4.5), squeeze=False
    )
    for panel, (name, series) in zip(axes[0], panels.items(), strict=True):
        for title, samples in series.items():
            if samples:
                draw(panel, title, samples)
        panel.set_title(name)
        panel.grid(visible=True, which="both", alpha=0.2)
    axes[0][0].set_ylabel(unit)
    drawn = [panel for panel in axes[0] if panel.get_legend_handles_labels()[0]]
    for panel in drawn[-1:]:
        panel.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(image, dpi=110)
    plt.close(figure)
    return True
