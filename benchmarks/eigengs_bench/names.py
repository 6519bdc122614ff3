"""Names that the command line offers, in a module that imports nothing slow."""

from typing import NamedTuple


class ImageSet(NamedTuple):
    """Images of one kind and size.

    Attributes
    ----------
    folder : str
        Where they are, below the folder of data.
    width, height : int
        Pixels. The largest centred part of an image is brought to this size.
    gaussians : int
        Splats that the paper uses at this size.
    """

    folder: str
    width: int
    height: int
    gaussians: int


SETS = {
    "faces256": ImageSet("faces256", 256, 256, 5000),
    "cats256": ImageSet("cats512", 256, 256, 5000),
    "cars256": ImageSet("cars256", 256, 256, 5000),
    "natural256": ImageSet("natural256", 256, 256, 5000),
    "cats512": ImageSet("cats512", 512, 512, 20000),
    "kodak": ImageSet("kodak", 768, 512, 20000),
}
"""The sets by name: the paper's kinds of images at its two sizes, and photos that may be shown."""

PAPER_SETS = tuple(name for name in SETS if name != "kodak")
"""Sets of the paper's kinds of images."""

NATURAL = "natural256"
"""Photos of all kinds. The paper's "universal" basis is trained on them."""

SAMPLES = "samples"
"""Photos of scikit-image, a set that needs no data."""

PRESETS = ("default", "gaussianimage", "eigengs")
"""Presets of `eigengs_dr.fit`."""

TABLES = ("main", "ablation", "cross", "reach")
"""What `tables` measures: the methods; colour spaces and the split; bases of other sets; and how
soon "default" has the PSNR that "gaussianimage" ends with."""

FIGURES = ("iterations", "colors", "curves", "radii", "split", "cross")
"""The paper's figures."""

CONDITIONS = ("cameras", "grazing", "hidden", "noise")
"""What the photos of `inverse` are like."""
