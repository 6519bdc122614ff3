"""Compose the picture of README.md, docs/images/teaser.jpg: ``python tools/manual/teaser.py``.

From left to right: a photo; outlines of Gaussians over their rendering; the Gaussians as the
texture of a poster in a Mitsuba scene; the texture that photos of this scene give back. Labels
have the PSNR in RGB against the photo. It takes a minute.
"""

from pathlib import Path

import eigengs_dr as eg  # isort: skip  (before Mitsuba: it finds libLLVM)
import mitsuba as mi
import numpy as np
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont

from eigengs_bench.subjects import bitmap, grey, load_scene
from eigengs_dr.image.color import to_coded
from eigengs_dr.plugins import photo_loss, texture_of
from eigengs_dr.viewer.pictures import overlay

TEASER = Path(__file__).parents[2] / "docs" / "images" / "teaser.jpg"
CELL, GAP = 300, 6  # pixels: sides of a picture, and white between two
LABEL, TEXT = 64, 25  # pixels: height of two lines below a picture, and of a letter
CAMERAS = 6
VIEW = {"origin": [1.9, 0.5, 3.1], "target": [0.05, -0.12, 0], "up": [0, 1, 0]}


def main() -> None:
    """Make the four pictures and write them side by side."""
    mi.set_variant("llvm_ad_rgb")
    eg.register_plugins()
    photo = eg.sample("coffee")[:400, 120:520]
    few = eg.fit(photo, 1500)
    many = eg.fit(photo, 5000, space="linear").gaussians
    texture = texture_of(many, wrap_mode="clamp")
    scene = load_scene(mi, "poster", {"color": texture}, CAMERAS)
    photos = [mi.render(scene, sensor=k, spp=64, seed=k).numpy() for k in range(CAMERAS)]
    unknown = load_scene(mi, "poster", {"color": bitmap(mi, grey("poster", "color"))}, CAMERAS)
    loss = photo_loss(unknown, "poster.bsdf.reflectance", photos, sensors=range(CAMERAS))
    recovered = eg.fit(loss=loss, size=(256, 256), iterations=480, space="linear")
    seen = eg.psnr(photo, eg.picture_of(recovered.gaussians, width=photo.shape[1]))
    outlined = overlay(few.gaussians, eg.picture_of(few.gaussians, width=800))
    rendered = to_coded(mi.render(scene, sensor=camera(), spp=512).numpy())
    pictures = {
        "a photo": photo,
        f"1,500 Gaussians,\n{few.psnr_rgb:.1f} dB": outlined,
        "5,000 Gaussians\nin a Mitsuba scene": rendered,
        f"recovered from {CAMERAS}\nphotos of it, {seen:.1f} dB": recovered.image,
    }
    cells = [np.asarray(cell_of(picture, label)) for label, picture in pictures.items()]
    gap = np.full((CELL + LABEL, GAP, 3), 255, np.uint8)
    strip = np.concatenate([part for cell in cells for part in (cell, gap)][:-1], axis=1)
    Image.fromarray(strip).save(TEASER, quality=88, optimize=True)


def camera() -> "mi.Sensor":
    """Return a camera that sees the picture in its room, from the side."""
    film = {"type": "hdrfilm", "pixel_format": "rgb", "width": CELL, "height": CELL}
    view = mi.ScalarTransform4f().look_at(**VIEW)
    return mi.load_dict({"type": "perspective", "fov": 40, "to_world": view, "film": film})


def cell_of(picture: np.ndarray, label: str) -> Image.Image:
    """Bring a picture to the size of a cell, above its label."""
    codes = Image.fromarray(np.uint8(255 * picture.clip(0, 1) + 0.5))
    cell = Image.new("RGB", (CELL, CELL + LABEL), "white")
    cell.paste(codes.resize((CELL, CELL), Image.Resampling.LANCZOS))
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), TEXT)
    draw = ImageDraw.Draw(cell)
    draw.multiline_text((CELL / 2, CELL + 2), label, "black", font, "ma", 2, "center")
    return cell


if __name__ == "__main__":
    main()
