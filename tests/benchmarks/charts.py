"""One picture a table: how far each figure is from its target."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.figures import FOLDER, Figure

MET, MISSED = "#2e7d5b", "#c0392b"


def ratios(name: str, title: str, figures: Sequence[Figure]) -> None:
    """out/figures/<name>.png: how many times as good as its target each figure is."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    rows = [(f.what, quality, f.met) for f in figures if (quality := _quality(f)) is not None]
    if not rows:
        return
    names, values, met = zip(*reversed(rows), strict=True)
    figure, axes = pyplot.subplots(figsize=(11, 1.2 + 0.34 * len(rows)), layout="constrained")
    bars = axes.barh(names, values, color=[MET if m else MISSED for m in met])
    axes.bar_label(bars, [f"{v:.2g}" for v in values], padding=3, fontsize=8)
    axes.axvline(1.0, color="black", linewidth=1)
    axes.set(xscale="log", title=title, xlabel="times as good as the target")
    axes.margins(x=0.12, y=0.02)
    axes.tick_params(labelsize=8)
    FOLDER.mkdir(parents=True, exist_ok=True)
    figure.savefig(FOLDER / f"{name}.png", dpi=130)
    pyplot.close(figure)


def _quality(figure: Figure) -> float | None:
    """How many times as good as its target a figure is; None without a positive target."""
    sign, _, rest = figure.target.partition(" ")
    limit = float(rest.split()[0]) if sign in ("<=", ">=") else 0.0
    if limit <= 0.0 or not isinstance(figure.value, int | float):
        return None
    value = max(float(figure.value), 1e-3 * limit)
    return value / limit if sign == ">=" else limit / value
