"""Names that the command line offers, in a module that imports nothing slow."""

from typing import NamedTuple


class ImageSet(NamedTuple):
    """A folder of images, their size in pixels, and the paper's number of Gaussians."""

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
PAPER_SETS = tuple(name for name in SETS if name != "kodak")
NATURAL, CATS = "natural256", "cats256"
SAMPLES = "samples"  # photos of scikit-image, a set that needs no data

PRESETS = ("default", "gaussianimage", "eigengs")
TABLES = ("main", "ablation", "cross", "reach")
FIGURES = ("iterations", "colors", "curves", "radii", "split", "cross")
CONDITIONS = ("cameras", "grazing", "hidden", "noise")
PARTS = ("pixels", "splats", "threads", "small")
KODAK_COUNTS = (5_000, 10_000, 30_000, 50_000, 70_000)  # Gaussians of published tables
SOLVE_STEPS = 10  # of the colour solve of a fit, by default
