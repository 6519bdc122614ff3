"""The command ``eigengs-dr fit`` for one image, fitted as a whole."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..image.color import rendered_as
from .console import progress_bar

if TYPE_CHECKING:
    from ..fitting.fit import Fit
    from ..fitting.options import FitOptions
    from ..material.fit_material import MaterialFit


def fit_one(
    path: Path | str,
    output: Path,
    preview: Path | None,
    quiet: bool,
    options: FitOptions,
    run: Callable[..., Fit],
) -> dict[str, Any]:
    """Fit one image, write its files, and return its figures."""
    import eigengs_dr as eg

    from ..fitting.fit import FitInterrupted
    from ..viewer.pictures import comparison, displayed

    started = time.perf_counter()
    name = Path(path).name
    with progress_bar(quiet) as show:
        show(f"{name}: load", 0, 1)
        image = eg.load_image(path, rendered_as(options.space) is None, options.encoding)
        loaded = time.perf_counter()
        try:
            result = run(image, progress=partial(show, name))
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


def course_of(result: Fit | MaterialFit, started: float, loaded: float) -> dict[str, Any]:
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
