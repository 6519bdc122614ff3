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
    "samples": ImageSet("", 256, 256, 5000),  # photos of scikit-image, which need no data
}
PAPER_SETS = ("faces256", "cats256", "cars256", "natural256", "cats512")
NATURAL, SAMPLES = "natural256", "samples"

PRESETS = ("default", "gaussianimage", "eigengs")
TABLES = ("main", "ablation")
PARTS = ("pixels", "splats", "small")
SUBJECTS_OF_SAMPLES = ("poster", "ball", "material", "text", "tiled", "room", "crate", "noisy")
SUBJECTS_OF_DATA = ("painting", "wall")
TEXTURE_PARTS = ("posters", "lights", "ball")
KODAK_COUNTS = (5_000, 10_000, 30_000, 50_000, 70_000)  # Gaussians of published tables
SOLVE_STEPS = 10  # of the colour solve of a fit, by default
