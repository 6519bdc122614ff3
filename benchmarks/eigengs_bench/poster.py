"""Memory of textures that look alike: bitmaps and Gaussians on a poster seen at a slant.

A poster of `TEXELS` x `TEXELS` texels fills the width of a film of half as many pixels. The
smallest bitmap and the smallest set of Gaussians are searched whose pictures reach 40 dB against
that of the poster, or 30 dB for a text: in 8 bits of sRGB, or of values for maps of one channel.
Pixels beside the poster do not count. The light is even, so that pictures have no noise.
"""

from collections.abc import Callable, Iterator
from functools import partial
from math import sqrt
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import eigengs_dr as eg
from eigengs_bench.clock import Image
from eigengs_bench.rows import Job, Row
from eigengs_dr.cli.scene import load_mitsuba
from eigengs_dr.image.color import to_coded
from eigengs_dr.image.resize import center_crop, resample

TEXELS, PIXELS, SPP = 1024, 512, 16
GOAL, TEXT_GOAL = 40.0, 30.0  # dB; sharp letters take too many Gaussians for 40
FINE = 1.03  # ratio of the sides of two bitmaps at which a search ends
SKY = 1.0  # radiance; a diffuse poster then shows its texture, without noise
PHOTOS = ("astronaut", "chelsea", "coffee", "retina", "rocket")
MAPS = ("brick", "gravel")  # of one channel, from scikit-image
SCANS = ("bark", "onyx", "rustymetal")  # colours, in the folder "textures" of DATA
SLOT = "poster.bsdf.reflectance"
PANGRAMS = (
    "The quick brown fox jumps over the lazy dog. Sphinx of black quartz, judge my vow. "
    "Pack my box with five dozen liquor jugs. "
)


class Poster(NamedTuple):
    """The image of a poster, `TEXELS` x `TEXELS`; the space of its Gaussians; the PSNR in dB."""

    kind: str
    image: Image
    space: str
    goal: float


def posters(data: Path | None) -> Iterator[tuple[str, Callable[[], Poster]]]:
    """Yield the names of the posters and functions that load them: photos, materials, a text."""
    for name in PHOTOS:
        yield name, partial(_poster, "photo", partial(eg.sample, name), "linear")
    for name in MAPS:
        yield name, partial(_poster, "material", partial(eg.sample, name), "data")
    for name in SCANS if data else ():
        file = Path(data or "") / "textures" / name / "albedo.jpg"
        yield name, partial(_poster, "material", partial(eg.load_image, file), "linear")
    yield "text", lambda: Poster("text", letters(TEXELS), "data", TEXT_GOAL)


def _poster(kind: str, load: Callable[[], Image], space: str) -> Poster:
    """Load an image for a poster; of maps, the first channel."""
    image = center_crop(load(), TEXELS, TEXELS).clip(0, 1)
    return Poster(kind, image[..., :1] if space == "data" else image, space, GOAL)


def letters(side: int) -> Image:
    """Draw black letters on white, shape (side, side, 1), in lines of a 32nd of the side."""
    from PIL import Image as pillow
    from PIL import ImageDraw, ImageFont

    page, font = pillow.new("L", (side, side), 255), ImageFont.load_default(side // 32)
    words = PANGRAMS * 12
    for line in range(20):
        place = side // 16, side // 16 + line * side // 23
        ImageDraw.Draw(page).text(place, words[64 * line : 64 * line + 64], 0, font)
    return np.asarray(page, np.float32)[..., None] / np.float32(255)


def jobs(variant: str, data: Path | None) -> Iterator[Job]:
    """Yield the measurement of each poster."""
    for name, load in posters(data):
        yield {"variant": variant, "poster": name}, partial(compare, variant, load)


def compare(variant: str, load: Callable[[], Poster]) -> Row:
    """Find the smallest bitmap and the fewest Gaussians that look like a poster.

    Returns
    -------
    dict
        `kind`; `side` of the bitmap in texels, and `gaussians`; `psnr_bitmap` and `psnr` of their
        pictures; `bitmap_bytes` and `bytes` that they hold in memory between renderings,
        `filtered_bytes` with a prefilter, `small_bytes` with `memory="small"`; `ratio` and
        `ratio_small`, of the bytes of Gaussians over those of the bitmap of 8 bits.
    """
    mi = load_mitsuba(variant, quiet=False)
    from eigengs_dr.plugins import resident_bytes

    poster = load()
    goal = picture(mi, bitmap(mi, poster.image))
    inside = 1.0 * (picture(mi, {"type": "rgb", "value": SKY / 2})[..., 0] < 0.75 * SKY)

    def psnr(texture: dict[str, Any]) -> float:
        rendering = picture(mi, texture)
        if poster.space == "data":
            return eg.psnr(rendering, goal, "data", weight=inside)
        return eg.psnr(to_coded(rendering), to_coded(goal), "rgb", weight=inside)

    side = _smallest_side(lambda n: psnr(bitmap(mi, resample(poster.image, n, n))) >= poster.goal)
    small = bitmap(mi, resample(poster.image, side, side))
    row: Row = {"kind": poster.kind, "side": side, "psnr_bitmap": psnr(small)}
    small = bitmap(mi, resample(poster.image, side, side))
    row["bitmap_bytes"] = resident_bytes(mi.load_dict(small))
    scene, target_psnr = scene_of(mi, bitmap(mi, poster.image)), poster.goal
    with TemporaryDirectory() as folder:
        file = {"type": "gaussian_texture", "filename": f"{folder}/poster.npz"}
        while row.get("psnr", 0.0) < poster.goal:  # of few Gaussians, many searches find as many
            fit = eg.fit_for_scene(scene, SLOT, poster.image, target_psnr, poster.space)
            fit.gaussians.save(file["filename"])
            row |= {"gaussians": len(fit.gaussians), "psnr": psnr(file)}
            target_psnr += poster.goal - row["psnr"] + 0.05
        row["bytes"] = resident_bytes(mi.load_dict(file))
        row["filtered_bytes"] = resident_bytes(mi.load_dict(file | {"prefilter": 1e-3}))
        row["small_bytes"] = resident_bytes(mi.load_dict(file | {"memory": "small"}))
    ratios = {"ratio": "bytes", "ratio_small": "small_bytes"}
    return row | {name: row[held] / row["bitmap_bytes"] for name, held in ratios.items()}


def _smallest_side(suffices: Callable[[int], bool]) -> int:
    """Return the smallest side in texels with which a bitmap suffices."""
    few, enough = 16, TEXELS
    while enough > max(FINE * few, few + 1):
        side = round(sqrt(few * enough))
        few, enough = (few, side) if suffices(side) else (side, enough)
    return enough


def bitmap(mi: Any, image: Image) -> dict[str, Any]:
    """Return an image as an 8-bit bitmap: sRGB, or values of one channel."""
    codes = np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)
    return {"type": "bitmap", "bitmap": mi.Bitmap(codes), "raw": image.shape[2] == 1}


def scene_of(mi: Any, texture: dict[str, Any]) -> Any:
    """Load the poster, which lies on the ground, and a camera above one side."""
    camera = mi.ScalarTransform4f().look_at([0, -2.75, 2.35], [0, -0.12, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": PIXELS, "height": PIXELS, "rfilter": {"type": "box"}}
    sampler = {"type": "stratified", "sample_count": SPP}
    sensor = {"type": "perspective", "fov": 42, "to_world": camera, "film": film}
    scene = {
        "type": "scene",
        "integrator": {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1},
        "sensor": {**sensor, "sampler": sampler},
        "poster": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": SKY}},
    }
    return mi.load_dict(scene)


def picture(mi: Any, texture: dict[str, Any]) -> NDArray[np.float32]:
    """Render the poster with a texture; linear, shape (H, W, 3)."""
    return np.clip(np.array(mi.render(scene_of(mi, texture), spp=SPP, seed=0)), 0, 1)
