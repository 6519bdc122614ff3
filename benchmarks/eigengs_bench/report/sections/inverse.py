"""Table, chart and film strips of the posters that `inverse` recovered."""

import pandas as pd
from matplotlib.figure import Figure

from eigengs_bench.experiments.inverse import GOAL, Result, figures_of
from eigengs_bench.report.charts import Picture, label_axes, new_figure, strip
from eigengs_bench.report.frames import Table, number
from eigengs_dr.image.color import to_coded
from eigengs_dr.image.resize import resample

TITLES = {
    "texels1024": "1,024 x 1,024 texels",
    "texels256": "256 x 256 texels",
    "gaussians": "Gaussians from grey",
    "coefficients": "coefficients",
    "both": "coefficients, then Gaussians",
}

SIDE, GAP = 96, 4  # side of a picture in a strip, and white pixels between two, in pixels


def results_table(results: dict[str, Result]) -> Table:
    """Lay out the figures of all conditions and methods."""
    figures = pd.DataFrame(figures_of(results))
    posters = figures.pop("condition") + ", " + figures.pop("method").map(TITLES)
    figures = figures.astype(float).map(number)
    figures.insert(0, "poster", posters)
    caption = f"PSNR / dB of recovered posters, also of halves; steps and seconds to {GOAL:g} dB"
    return Table(caption, figures)


def results_chart(results: dict[str, Result]) -> Figure:
    """Draw PSNR over steps and over seconds, a column a condition."""
    figure = new_figure(3.2 * len(results), 5.6)
    axes = figure.subplots(2, len(results), squeeze=False, sharey=True)
    for (steps, seconds), (name, result) in zip(axes.T, results.items(), strict=True):
        for method, trace in result.traces.items():
            steps.plot(trace.steps, trace.psnr_ycbcr, label=TITLES[method])
            # The start, at 0 seconds, has no place on a logarithmic scale.
            seconds.plot(trace.seconds[1:], trace.psnr_ycbcr[1:])
        label_axes(steps, "steps", "PSNR (YCbCr) / dB", "", steps is axes[0, 0], title=name)
        steps.set_xscale("symlog", linthresh=1)
        label_axes(seconds, "seconds", "PSNR (YCbCr) / dB", legend=False)
    return figure


def film_strip(result: Result) -> Picture:
    """Draw a condition: its photos, then a row a method, a column a step, the truth at the end."""
    height, width = result.photos.shape[:2]
    photos = resample(to_coded(result.photos.clip(0, 1)), round(SIDE * width / height), SIDE)
    rows = [("photos", [("", photos[:, k : k + SIDE]) for k in range(0, photos.shape[1], SIDE)])]
    for method, trace in result.traces.items():
        reached = dict(zip(trace.steps, trace.psnr_ycbcr, strict=True))
        cells = [(f"{n}: {reached[n]:.1f} dB", picture) for n, picture in trace.pictures.items()]
        rows.append((TITLES[method], [*cells, ("truth", result.truth)]))
    return strip(rows, side=SIDE, gap=GAP)
