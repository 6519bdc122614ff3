"""The method of EigenGS, for `eigengs_dr.fit`.

Source: Tai et al., "EigenGS Representation: From Eigenspace to Gaussian Image Space" (CVPR 2025).
It uses the descent of GaussianImage, starting from the projection of the image on the eigenbasis.
The mean image of the family is stored as pixels, which are not part of the Gaussians.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from ..fitting.method import Method, Model
from ..fitting.objective import Pixels
from ..gaussian.gaussians import Gaussians
from ..image.space import Space
from ..raster.render import to_tiles
from .gaussianimage import GAUSSIANIMAGE


@dataclass(frozen=True, repr=False)
class EigenGSMethod(Method):
    """A method that starts from the projection on the components of a model."""

    needs_model = True

    def start_from_model(
        self, objective: Pixels, model: Model, pixels: NDArray[np.float32]
    ) -> tuple[Pixels, Gaussians]:
        """Return the objective minus the mean image, and the projection of the image.

        The mean image becomes the base of the picture of the objective.
        """
        mean = model.dense_mean(*objective.size)
        target = objective.model.target - to_tiles(objective.types, mean)
        base = to_tiles(objective.types, mean_picture(mean, objective.space))
        pictures = tuple(picture._replace(base=base) for picture in objective.pictures)
        model_of_error = objective.model._replace(target=target)
        objective = replace(objective, model=model_of_error, pictures=pictures)
        gaussians = model.encode(pixels, "projected", "dense")
        return objective, replace(gaussians, cutoff=float(self.cutoff))


def mean_picture(mean: NDArray[np.float32], space: Space) -> NDArray[np.float32]:
    """Return a mean image (H, W, C) as RGB minus the RGB of zeros, which a rendering includes."""
    rgb = space.decode_image(mean)
    return np.asarray(rgb - np.array(space.decode([0.0] * mean.shape[2]), np.float32))


EIGENGS = EigenGSMethod(**{f.name: getattr(GAUSSIANIMAGE, f.name) for f in fields(Method)})
"""The method of EigenGS, which needs a model to start from."""
