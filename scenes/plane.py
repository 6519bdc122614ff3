"""Error of the plane at one sample per pixel, against 1,024: ``python scenes/plane.py``.

The script prints mean squared errors of linear radiance over the whole picture. ``--strip FILE``
writes crops of the pictures side by side.
"""

import time
from functools import partial
from pathlib import Path

import click
import mitsuba as mi
import numpy as np
from assets import FOLDER, fitted, floor

import eigengs_dr as eg
from eigengs_dr.backend.selection import select
from eigengs_dr.image.color import to_coded
from eigengs_dr.plugins import pixel_angle

SCENE = Path(__file__).parent / "plane.xml"

TEXELS = 1024
"""Side in pixels of the bitmap to compare the Gaussians with."""

PASS = 16
"""Most samples per pixel in one rendering."""

MORE = 8
"""Samples per pixel of the second error in the table."""

CROP = (1 / 10, 1 / 2, 3 / 10, 7 / 10)
"""Top, bottom, left and right of the crops, as shares of the picture's side."""


def write_sets():
    """Fit the floor in linear and in coded colours, and draw its bitmap, ``floor.exr``."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    linear = fitted(FOLDER, "floor", floor(), 4000, "linear")
    fitted(FOLDER, "floor-coded", floor(), 4000, "ycbcr")
    texels = np.clip(eg.render(eg.Gaussians.load(linear), width=TEXELS).numpy(), 0, 1)
    mi.Bitmap(texels).write(str(FOLDER / "floor.exr"))


def load(name, resolution, bitmap=False, prefilter=False):
    """Load the scene of the plane.

    Parameters
    ----------
    name : str
        Name of the texture's file without suffix.
    resolution : int
        Side of the picture in pixels.
    bitmap : bool, optional
        Use Mitsuba's bitmap texture with the same properties, and the .exr file.
    prefilter : bool, optional
        Filter the Gaussians by the footprint of a pixel.

    Returns
    -------
    mitsuba.Scene
    """
    xml = SCENE.read_text().replace("floor.npz", f"{name}.{'exr' if bitmap else 'npz'}")
    if bitmap:
        xml = xml.replace('type="gaussian_texture"', 'type="bitmap"')
        xml = xml.replace(
            '<float name="prefilter" value="$prefilter"/>', '<boolean name="raw" value="true"/>'
        )
        return mi.load_string(xml, folder=str(FOLDER), resolution=str(resolution))
    load_string = partial(mi.load_string, xml, folder=str(FOLDER), resolution=str(resolution))
    scene = load_string(prefilter="0")
    return load_string(prefilter=str(pixel_angle(scene.sensors()[0]))) if prefilter else scene


def image_of(scene, spp, seed):
    """Return the mean of `spp` samples per pixel: linear radiance, float64, shape (H, W, 3)."""
    passes = range(0, spp, PASS)
    return sum(
        np.array(mi.render(scene, spp=min(PASS, spp), seed=seed + i), np.float64) for i in passes
    ) / len(passes)


@click.command()
@click.option("--resolution", type=int, default=600, show_default=True)
@click.option("--reference", type=int, default=1024, show_default=True, help="Samples per pixel.")
@click.option("--seeds", type=int, default=8, show_default=True, help="Pictures per mean.")
@click.option("--strip", type=click.Path(path_type=Path), help="Picture of crops side by side.")
def main(resolution, reference, seeds, strip):
    """Measure the error at one sample per pixel, and print a table."""
    mi.set_variant("cuda_ad_rgb" if "cuda" in select().__name__ else "llvm_ad_rgb")
    eg.register_plugins()
    write_sets()
    kinds = {
        "bitmap": ("floor", {"bitmap": True}),
        "Gaussians": ("floor", {}),
        "Gaussians, prefiltered": ("floor", {"prefilter": True}),
        "coded Gaussians": ("floor-coded", {}),
        "coded Gaussians, prefiltered": ("floor-coded", {"prefilter": True}),
    }
    # The seed of the reference differs from the seeds of all pictures.
    truth = {
        name: image_of(load(name, resolution), reference, 10_000)
        for name in ("floor", "floor-coded")
    }
    pictures = []
    print(f"{resolution}x{resolution} pixels, mean of {seeds} seeds; seconds of CPU, all cores")
    for kind, (name, settings) in kinds.items():
        scene = load(name, resolution, **settings)
        image_of(scene, 1, 0)  # compiles
        started = time.process_time()
        images = [image_of(scene, 1, seed) for seed in range(seeds)]
        seconds = (time.process_time() - started) / seeds
        errors = [np.square(image - truth[name]).mean() for image in images]
        more = np.square(image_of(scene, MORE, seeds) - truth[name]).mean()
        print(
            f"{kind:30} {np.mean(errors):.2e} +- {np.std(errors):.0e} in {seconds:.2f} s; "
            f"{MORE} samples: {more:.2e}"
        )
        pictures.append(images[0])
    if strip:
        top, bottom, left, right = (round(side * resolution) for side in CROP)
        crops = [p[top:bottom, left:right] for p in (*pictures[:3], truth["floor"])]
        eg.save_image(strip, to_coded(np.concatenate(crops, axis=1)))


if __name__ == "__main__":
    main()
