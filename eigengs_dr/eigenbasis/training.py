"""Training of a model on a folder of images, with checkpoints and figures of held-out images."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..backend.interrupts import Interrupted, defer_interrupts
from ..backend.messages import warn
from ..backend.types import Record
from ..image.folder import list_images
from ..image.io import Codes, ImageError, check_member
from ..image.metrics import psnr
from ..image.notes import series
from ..image.resize import center_crop
from ..paper.joint_training import State
from ..raster.render import render
from ..storage.checkpoint import Checkpoint, open_checkpoint
from .basis import Eigenbasis
from .components import TrainOptions, fit_model
from .eigengs import EigenGS
from .truncation import TruncationCurve

HELD_OUT = 10
"""One in this number of images is held out of the training and measured."""

MAX_HELD_OUT = 100
"""Largest number of measured images; more would change the figures little."""

SAVE_SECONDS = 10.0
"""Seconds between two checkpoints of the shapes."""


class Training(NamedTuple):
    """Result of `train_model`: the model, the basis that it renders, and figures.

    The figures are ``seconds``, ``pca_seconds``, ``shape_seconds``, ``weight_seconds`` (of the last
    run only if ``resumed``), ``images``, ``iterations``, ``components`` (of each channel),
    ``gaussians``, ``frequency_aware``, ``psnr_held_out`` (`held_out` of the model), those of
    `eigengs_dr.eigenbasis.components.fit_model`, and the mean psnr_ycbcr of held-out images:
    of PCA (``psnr_pca``), of projected colours (``psnr_init``) and of exact colours
    (``psnr_solved``).
    """

    model: EigenGS
    basis: Eigenbasis
    figures: Record


def train_model(
    folder: str | os.PathLike[str],
    output: str | os.PathLike[str],
    settings: TrainOptions,
    backend: str | None = None,
    progress: Callable[[int, int, Record], None] = lambda done, total, row: None,
    client: object = None,
) -> Training:
    """Train a model on a folder of images, and write it.

    The folder ``OUTPUT.checkpoint`` stores the state of an unfinished run. After Ctrl-C or a crash,
    the same call resumes from there, with the same images, and gives the same result.

    Parameters
    ----------
    folder : path-like
        Folder of images, or a pattern such as "faces/*.png"; one in `HELD_OUT` is held out and
        measured.
    output : path-like
        File of the model.
    settings : TrainOptions
    backend : {"llvm", "cuda"}, optional
    progress : callable, optional
        ``progress(done, total, row)``; the row has the ``stage``: "components", "weights", "shapes"
        or "measure".
    client : distributed.Client, optional
        Compute components on the workers of this Dask cluster, see
        `eigengs_dr.Eigenbasis.from_images`. The images must be on a shared file system.

    Raises
    ------
    Interrupted
        After Ctrl-C; its result is the folder from which the same call resumes, or None if nothing
        is saved.
    ClusterError
        If the cluster cannot be used, or is lost; the same call resumes.
    ValueError
        If no image can be read, or the settings are invalid or differ from the checkpoint.
    OSError
        If a file cannot be written.
    """
    started = time.perf_counter()
    images = list_images(folder)
    root = Path(folder) if os.path.isdir(folder) else Path()  # a pattern gives whole paths
    names = [str(path) if root == Path() else Path(path).name for path in images]
    steps = settings.training_steps
    record = {**asdict(settings), "iterations": steps, "folder": str(folder)}
    with (
        open_checkpoint(output, record, names) as checkpoint,
        defer_interrupts() as interrupted,
        series(),
    ):
        if names != checkpoint.files:
            warn(
                f"{folder}: the images have changed since this training began; it continues with "
                f"the original {len(checkpoint.files)}"
            )
        files = [root / name for name in checkpoint.files]
        held_out = files[HELD_OUT - 1 :: HELD_OUT][:MAX_HELD_OUT]
        training = [path for i, path in enumerate(files) if i % HELD_OUT != HELD_OUT - 1]
        run = _Run(checkpoint, settings, backend, progress, interrupted, held_out, client)
        try:
            basis = _basis(training, run)
            pca_seconds = time.perf_counter() - started
            model = _model(basis, run)
            scores = _evaluate(model, basis, run)
        except ValueError as error:
            if not checkpoint.holds_work:
                raise
            raise ValueError(f"{error}; to start again, delete {checkpoint.folder}") from None
        figures = {
            "resumed": checkpoint.resumed,
            "images": basis.count,
            "components": list(model.components),
            "gaussians": len(model.gaussians),
            "frequency_aware": model.low > 0,
            "psnr_held_out": model.held_out.tolist(),
            "iterations": steps,
            "pca_seconds": pca_seconds,
            **model.figures,
            **scores,
            "seconds": time.perf_counter() - started,
        }
        model.save(output)
    return Training(model, basis, figures)


class _Run(NamedTuple):
    """State that all stages of a training share."""

    checkpoint: Checkpoint
    settings: TrainOptions
    backend: str | None
    progress: Callable[[int, int, Record], None]
    interrupted: Callable[[], bool]
    held_out: Sequence[Path]
    client: object

    def report(self, stage: str, done: int, total: int) -> None:
        """Report progress, and stop after Ctrl-C."""
        self.progress(done, total, {"stage": stage})
        self.stop_if_interrupted()

    def stop_if_interrupted(self) -> None:
        """Raise `Interrupted` after Ctrl-C."""
        if not self.interrupted():
            return
        if self.checkpoint.holds_work:
            raise Interrupted(self.checkpoint.folder, "repeat the command to continue")
        raise Interrupted(None, "nothing is saved")


def _basis(files: list[Path], run: _Run) -> Eigenbasis:
    """Compute the components, or read them from the checkpoint, which also stores shards."""
    settings, checkpoint = run.settings, run.checkpoint
    if (path := checkpoint.folder / "basis.npz").exists():
        return Eigenbasis.load(path)

    basis = Eigenbasis.from_images(
        files,
        settings.size,
        settings.components,
        settings.energy,
        settings.space,
        lambda done, total, row: run.report("components", done, len(files)),
        run.client,
        checkpoint.folder,
        settings.encoding,
    )
    if settings.target_psnr is not None:
        if (curve := _curve(basis, run)) is None:
            raise ValueError(
                f"target_psnr needs held-out images, one in {HELD_OUT}, and none can be read; give "
                "more images, or use energy"
            )
        basis = basis.truncated(curve.rank_for_psnr(settings.target_psnr))
    basis.save(path)
    checkpoint.remove("pca*")
    return basis


def _model(basis: Eigenbasis, run: _Run) -> EigenGS:
    """Fit Gaussians to the components, and save checkpoints."""
    checkpoint, curve = run.checkpoint, _curve(basis, run)
    run.report("weights", 0, 1)
    saved = time.perf_counter()

    def save(states: list[State], step: int, steps: int) -> None:
        nonlocal saved
        run.progress(step, steps, {"stage": "shapes"})
        if run.interrupted() or time.perf_counter() - saved > SAVE_SECONDS:
            saved = time.perf_counter()
            for band, state in enumerate(states):
                checkpoint.save(f"shapes-{band}", state)
        run.stop_if_interrupted()

    states: list[State] = []
    while (state := checkpoint.load(f"shapes-{len(states)}")) is not None:
        states.append(state)
    fields = fit_model(basis, run.settings, run.backend, states, save)
    return EigenGS(**fields, held_out=np.zeros(0) if curve is None else curve.psnr)


def _curve(basis: Eigenbasis, run: _Run) -> TruncationCurve | None:
    """Return the truncation curve of the held-out images, None if none can be read."""
    images = _readable(basis, run)
    first = next(images, None)
    return None if first is None else basis.truncation_curve(chain([first], images))


def _evaluate(model: EigenGS, basis: Eigenbasis, run: _Run) -> dict[str, float]:
    """Measure the held-out images, for the figures of `Training`, and warn about failures."""
    rows: list[dict[str, float]] = []
    errors: list[str] = []
    for image in _readable(basis, run, errors, "measure"):
        pictures = {
            "psnr_pca": basis.reconstruct(basis.project(image)),
            "psnr_init": render(model.encode(image, "projected")).numpy(),
            "psnr_solved": render(model.encode(image, "exact")).numpy(),
        }
        rows.append({name: psnr(image.pixels, p, "ycbcr") for name, p in pictures.items()})
    if errors:
        skipped = f"{len(errors)} of {len(run.held_out)} held-out images were skipped"
        warn(f"{skipped}, for example {errors[0]}")
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]} if rows else {}


def _readable(
    basis: Eigenbasis, run: _Run, errors: list[str] | None = None, stage: str = ""
) -> Iterator[Codes]:
    """Read the held-out images at the size of a basis; skip those that cannot be read."""
    for done, path in enumerate(run.held_out):
        if stage:
            run.progress(done, len(run.held_out), {"stage": stage})
        run.stop_if_interrupted()
        try:
            image = check_member(path, run.settings.encoding)
            image = center_crop(image, basis.width, basis.height)
        except (ImageError, OSError) as error:
            if errors is not None:
                errors.append(str(error))
        else:
            yield Codes(image)
