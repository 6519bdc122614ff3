"""The options of a training, which are checked once."""

from __future__ import annotations

from dataclasses import dataclass

from ..backend.doors import plain_numbers
from ..image.pixels import check_size
from ..image.space import FAMILY_SPACES, space_of
from .pca.basis import check_components
from .pca.truncation import check_target

STEPS = {"default": 0, "eigengs": 15_000}
"""The presets, with their default numbers of training steps."""


@dataclass(frozen=True)
class TrainOptions:
    """Options of a training, some of which are those of `eigengs_dr.EigenGS.fit`.

    Attributes
    ----------
    size : (int, int)
        Width and height in pixels.
    components : int or tuple of 3 ints
        Largest number of components of each channel.
    energy : float or None
        Keep the fewest components that hold this share of a channel's variance.
    target_psnr : float or None
        Keep the fewest components whose PCA has this mean PSNR, in dB, for the held-out images; see
        `eigengs_dr.eigenbasis.pca.truncation.TruncationCurve`.
    gaussians, frequency_aware, preset, iterations, seed
        See `eigengs_dr.EigenGS.fit`.
    space : {"ycbcr", "rgb"}
        Space of the components.

    Raises
    ------
    ValueError
        If an option is out of range, or two options exclude each other; one line that names it.
    """

    size: tuple[int, int] = (256, 256)
    components: int | tuple[int, int, int] = 300
    energy: float | None = None
    target_psnr: float | None = None
    gaussians: int = 5000
    frequency_aware: bool | str = "auto"
    preset: str = "default"
    iterations: int | None = None
    space: str = "ycbcr"
    seed: int = 0

    def __post_init__(self) -> None:
        for name, value in plain_numbers(vars(self), TrainOptions.__annotations__).items():
            object.__setattr__(self, name, value)
        check_components(self.components, self.energy)
        if self.target_psnr is not None:
            check_target(self.target_psnr)
            if self.energy is not None:
                raise ValueError(
                    "energy and target_psnr both choose the components; give one of them"
                )
        object.__setattr__(self, "space", space_of(self.space, FAMILY_SPACES))
        if self.preset not in STEPS:
            raise ValueError(f"preset {self.preset!r} is unknown; use one of {', '.join(STEPS)}")
        counts = {
            "gaussians": self.gaussians,
            "seed": self.seed,
            "iterations": self.training_steps,
        }
        for name, number in counts.items():
            if number < 0:
                raise ValueError(f"{name} is {number}; it must be at least 0")
        width, height = check_size(self.size)
        if not 1 <= self.gaussians <= width * height:
            raise ValueError(
                f"gaussians is {self.gaussians}; a basis of {width}x{height} takes 1 to "
                f"{width * height}"
            )
        if self.preset == "eigengs" and self.training_steps < 1:
            raise ValueError("iterations is 0; preset 'eigengs' needs training, so give at least 1")
        if self.preset == "default" and self.training_steps:
            raise ValueError(
                f"iterations is {self.iterations}; preset 'default' trains nothing, so leave them "
                "out, or use preset 'eigengs'"
            )
        if not isinstance(self.frequency_aware, bool) and self.frequency_aware != "auto":
            raise ValueError(
                f"frequency_aware is {self.frequency_aware!r}; use 'auto', True or False"
            )

    @property
    def training_steps(self) -> int:
        """Number of training steps: the given number, or that of the preset."""
        return STEPS[self.preset] if self.iterations is None else self.iterations
