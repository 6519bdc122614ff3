"""The command ``eigengs-dr fit`` for several images: one run, one row of the report each."""

from __future__ import annotations

import time
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..image.metrics import float_space
from .console import images_bar, say
from .fit_one import measure_fit

if TYPE_CHECKING:
    from ..collection.row import Finished
    from ..fitting.options import FitOptions, Levels

Record = dict[str, Any]


def fit_several(
    paths: list[Path | str],
    folder: Path,
    previews: list[Path],
    options: FitOptions,
    levels: Levels | None,
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
    options, levels, overwrite
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

        _, images = fit_each(paths, folder, overwrite, options, levels, step, client)
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
        click.echo(_summary(ordered, folder, time.perf_counter() - started, space))
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


def _summary(records: list[Record], folder: Path, seconds: float, space: str) -> str:
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
