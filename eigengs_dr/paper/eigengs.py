"""The method of EigenGS, for `eigengs_dr.fit`.

Source: Tai et al., "EigenGS Representation: From Eigenspace to Gaussian Image Space" (CVPR 2025).
It descends as GaussianImage does, from the projection of the image on the eigenbasis. The mean
image of the family stays pixels, which are no part of the Gaussians.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from ..fitting.method import Method, Model
from ..fitting.objective import Pixels
from ..gaussian.gaussians import Gaussians
from ..image.color import decode
from ..raster.render import batch_to_tiles
from .gaussianimage import GAUSSIANIMAGE


@dataclass(frozen=True, repr=False)
class EigenGSMethod(Method):
    """A method that starts from the projection on the components of a model."""

    needs_model = True

    def start_from_model(
        self, objective: Pixels, model: Model, pixels: NDArray[np.float32]
    ) -> tuple[Pixels, Gaussians]:
        """Return the objective less the mean image, and the projection of the image.

        The picture of the objective has the mean image as its base.
        """
        mean = model.dense_mean(*objective.size)
        assert objective.model.target is not None
        left = objective.model.target - batch_to_tiles(objective.types, mean)
        base = batch_to_tiles(objective.types, mean_picture(mean, objective.space))
        pictures = tuple(picture._replace(base=base) for picture in objective.pictures)
        objective = replace(
            objective, model=objective.model._replace(target=left), pictures=pictures
        )
        gaussians = model.encode(pixels, "projected", "dense")
        return objective, replace(gaussians, cutoff=float(self.cutoff))


def mean_picture(mean: NDArray[np.float32], space: str) -> NDArray[np.float32]:
    """Return a mean image (H, W, C) as RGB to add: a rendering already holds the RGB of zeros."""
    rgb = np.stack(decode(space, list(np.moveaxis(mean, 2, 0))), axis=2)
    return np.asarray(rgb - np.array(decode(space, [0.0] * mean.shape[2]), np.float32))


EIGENGS = EigenGSMethod(**{f.name: getattr(GAUSSIANIMAGE, f.name) for f in fields(Method)})
"""The method of EigenGS; it needs a model as the start of the fit."""
