"""Pictures of the results, where matplotlib (the extra "bench") is installed."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path


def path(image: Path, series: Mapping[tuple[str, int], Sequence[float]], titles: Mapping[str, str]) -> bool:
    """Draw the distribution of one-way latencies (µs) by contender, one panel a size; return whether it was drawn."""
    try:
        import matplotlib as mpl
    except ImportError:
        return False
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    sizes = sorted({size for _, size in series})
    figure, panels = plt.subplots(1, len(sizes), figsize=(6 * len(sizes), 4.5), squeeze=False)
    for panel, size in zip(panels[0], sizes, strict=True):
        for key, title in titles.items():
            values = sorted(series.get((key, size), ()))
            if values:
                panel.plot(values, [(i + 1) / len(values) for i in range(len(values))], label=title, linewidth=1.2)
        panel.set_xscale("log")
        panel.set_xlabel("one way, µs")
        panel.set_title(f"{size} B")
        panel.grid(visible=True, which="both", alpha=0.2)
    panels[0][0].set_ylabel("share of messages at most this late")
    panels[0][-1].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(image, dpi=110)
    plt.close(figure)
    return True
