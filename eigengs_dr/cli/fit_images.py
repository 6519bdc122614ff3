"""The command ``eigengs-dr fit`` for one image, and for several: one row of the report each."""

from __future__ import annotations

import time
from collections import Counter
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..image.color import rendered_as
from ..image.metrics import float_space
from .console import images_bar, progress_bar, say

if TYPE_CHECKING:
    from ..collection.manifest import Finished
    from ..fitting.fit import Fit
    from ..fitting.options import FitOptions


def fit_one(
    path: Path | str,
    output: Path,
    preview: Path | None,
    quiet: bool,
    options: FitOptions,
) -> dict[str, Any]:
    """Fit one image, write its files, and return its figures."""
    import eigengs_dr as eg

    from ..fitting.fit import FitInterrupted, fit_image
    from ..viewer.pictures import comparison, displayed

    started = time.perf_counter()
    name = Path(path).name
    with progress_bar(quiet) as show:
        show(f"{name}: load", 0, 1)
        image = eg.load_image(path, rendered_as(options.space) is None, options.encoding)
        loaded = time.perf_counter()
        try:
            result = fit_image(image, options, partial(show, name))
        except FitInterrupted as interrupt:
            result = interrupt.result
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        replace(result, source=name).save(output)
        show(f"{name}: measure", 0, 1)
        shown = displayed(image, options.space)
        color = result.gaussians.space
        figures = measure_fit(shown, result, color)
        if preview:
            eg.save_image(preview, comparison(shown, result.image, result.gaussians))
    record = {
        "input": str(path),
        "output": str(output),
        "width": image.shape[1],
        "height": image.shape[0],
        "gaussians": len(result.gaussians),
        "space": result.gaussians.space,
        **course_of(result, started, loaded),
        **figures,
        "trace": result.trace,
    }
    if not quiet:
        click.echo(_summary(record, preview, color))
    return record


def course_of(result: Fit, started: float, loaded: float) -> dict[str, Any]:
    """Return how a fit went, for a report; `loaded` is the time when the images were there."""
    return {
        "iterations": result.iterations,
        "stopped": result.stopped,
        "seconds": result.seconds,
        "seconds_init": result.seconds_init,
        "seconds_load": loaded - started,
        "seconds_total": time.perf_counter() - started,
    }


def measure_fit(image: Any, result: Fit, space: str) -> dict[str, float]:
    """Compare a fit with its image; data are in the unit of the fit."""
    import eigengs_dr as eg

    from ..fitting.target import unit_of

    unit = unit_of(image, space)
    seen, shown = image / unit, result.image / unit
    return {
        "psnr_ycbcr": result.psnr_ycbcr,
        "psnr_rgb": result.psnr_rgb,
        "ssim": eg.ssim(seen, shown),
        "ms_ssim": eg.ms_ssim(seen, shown, space="ycbcr" if rendered_as(space) else "data"),
    }


def _summary(record: dict[str, Any], preview: Path | None, space: str) -> str:
    """Describe a fit for a terminal."""
    from ..image.metrics import float_space

    text = (
        "{input}: {width}x{height}, {gaussians} Gaussians, {iterations} iterations "
        "in {seconds:.1f} s ({seconds_total:.1f} s with loading and measuring)\n"
        "  psnr_{shown} {psnr_ycbcr:.2f} dB, psnr_rgb {psnr_rgb:.2f} dB, "
        "SSIM {ssim:.4f}, MS-SSIM {ms_ssim:.4f}\n  wrote {output}"
    ).format(**record, shown=float_space(space))
    return f"{text}\n  wrote {preview} (photo, fit and outlines side by side)" if preview else text


Record = dict[str, Any]


def fit_several(
    paths: list[Path | str],
    folder: Path,
    previews: list[Path],
    options: FitOptions,
    overwrite: bool,
    quiet: bool,
    measure: bool,
    client: Any = None,
) -> tuple[list[Record], bool]:
    """Fit images into a folder, and say what failed as it fails.

    Parameters
    ----------
    paths : list of Path or str
        Image files, or their URLs.
    folder : Path
        Folder of the results.
    previews : list of Path
        A picture for each image, or none.
    options, overwrite
        See `eigengs_dr.fit_many`.
    quiet : bool
        Show no bar and no summary.
    measure : bool
        Also compute SSIM and MS-SSIM, for a report. On a cluster they are not computed.
    client : distributed.Client, optional
        See `eigengs_dr.fit_many`.

    Returns
    -------
    records : list of dict
        A record for each image that is done; its key "stopped" is "skipped", "failed" or that of
        `eigengs_dr.Fit`.
    interrupted : bool
        Whether Ctrl-C ended the run.
    """
    from ..collection.fit_many import fit_each

    started, records = time.perf_counter(), dict[int, Record]()
    interrupted = False
    with images_bar(quiet, len(paths)) as show:
        label = ""

        def step(share: float) -> None:
            show(len(records) + min(share, 1), label)

        _, images = fit_each(paths, folder, overwrite, options, step, client)
        try:
            with closing(images):
                for finished in images:
                    preview = previews[finished.place] if previews else None
                    record = _record(finished, preview, options.space, measure)
                    records[finished.place] = record
                    if record["stopped"] == "failed":
                        say(f"error: {record['error']}")
                    elif finished.row.psnr_rgb is not None:
                        label = f"{finished.row.psnr_rgb:.2f} dB"
                    show(len(records), label)
        except KeyboardInterrupt:
            interrupted = True
    if interrupted:
        done = f"{len(records)} of {len(paths)} images are done"
        say(f"interrupted; {done}; the same command fits the others")
    ordered = [records[place] for place in sorted(records)]
    if not quiet:
        space = float_space(options.space)
        click.echo(_summary_of_all(ordered, folder, time.perf_counter() - started, space))
    return ordered, interrupted


def _record(finished: Finished, preview: Path | None, space: str, measure: bool) -> Record:
    """Return the figures of one image, and write its preview."""
    import eigengs_dr as eg

    from ..viewer.pictures import comparison, displayed

    row, pixels = finished.row, finished.pixels
    record: Record = {"input": str(row.input), "output": str(row.output)}
    if row.status != "done":
        reason = {"error": row.error} if row.error else {}
        return {**record, "stopped": row.status, **reason}
    names = ("width", "height", "gaussians", "iterations", "stopped", "seconds")
    record |= {name: getattr(row, name) for name in (*names, "psnr_ycbcr", "psnr_rgb")}
    if pixels is None:  # it stays with the worker that fitted it
        return record
    result, pixels = row.result, displayed(pixels, space)
    record["seconds_init"] = result.seconds_init
    if preview:
        try:
            eg.save_image(preview, comparison(pixels, result.image, result.gaussians))
        except ValueError as error:
            return {**record, "stopped": "failed", "error": str(error)}
    if measure:
        record |= measure_fit(pixels, result, space) | {"trace": result.trace}
    return record


def _summary_of_all(records: list[Record], folder: Path, seconds: float, space: str) -> str:
    """Describe a run for a terminal."""
    fitted = [record for record in records if "psnr_rgb" in record]
    counts = Counter(record["stopped"] for record in records)
    others = "".join(f", {counts[k]} {k}" for k in ("skipped", "failed") if counts[k])
    text = f"{len(fitted)} image{'s' * (len(fitted) != 1)} fitted{others} in {seconds:.1f} s"
    if fitted:
        ycbcr, rgb = (
            sum(record[key] for record in fitted) / len(fitted)
            for key in ("psnr_ycbcr", "psnr_rgb")
        )
        rate = f" ({len(fitted) / seconds:.2g} images/s)"
        text += f"{rate}\n  mean psnr_{space} {ycbcr:.2f} dB, psnr_rgb {rgb:.2f} dB"
    if counts["skipped"]:
        text += "\n  --overwrite fits the skipped images, whose results exist, again"
    return f"{text}\n  wrote {folder}" if fitted else text
