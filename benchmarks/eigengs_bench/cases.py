"""Hard cases: images, starts and settings under which a descent might fail; no files are needed."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image as pillow
from PIL import ImageDraw

import eigengs_dr as eg
from eigengs_bench.clock import Image
from eigengs_dr.gaussian.covariance import factor_from_covariance
from eigengs_dr.image.resize import center_crop

Shapes = tuple[NDArray[np.float64], NDArray[np.float64]]

# Pixels per side, Gaussians (as in the paper, and in the basis that ships), and steps.
SIDE, GAUSSIANS, ITERATIONS = 256, 5000, 1000
SMOOTH_SIDE = 512  # distances of 7 pixels show; those of the paper's 20,000 are below 4
STRIPE = 3  # rows of a stripe of the image that is foreign to a basis


class Case(NamedTuple):
    """One thing that may go wrong.

    ``image()`` makes the image. `place`, a `Placement`, returns means and factors to start from;
    None for the start of the method. `rates` multiplies the rates of the method. `space` is the
    colour space of the fit, by default that of the method.
    """

    name: str
    image: Callable[[], Image]
    gaussians: int = GAUSSIANS
    iterations: int = ITERATIONS
    place: Callable[..., Shapes] | None = None
    rates: float = 1.0
    space: str | None = None
    seeds: Sequence[int] = (0,)


def photo(width: int = SIDE, height: int = SIDE) -> Image:
    """Resize a photo of a cat to so many pixels; enlarged, it is smooth."""
    return np.clip(center_crop(eg.sample("chelsea"), width, height), 0, 1)


def flat(red: float, green: float, blue: float) -> Image:
    """Fill an image with one colour; 1 is white."""
    return np.broadcast_to(np.array([red, green, blue], np.float32), (SIDE, SIDE, 3)).copy()


def _impulse() -> Image:
    image = flat(0, 0, 0)
    image[SIDE // 2, SIDE // 2] = 1
    return image


def _checkerboard() -> Image:
    return _grey(np.indices((SIDE, SIDE)).sum(axis=0) % 2)


def _lines() -> Image:
    canvas = pillow.new("L", (SIDE, SIDE))
    for end in range(0, SIDE, 12):
        for corner in ((SIDE - 1, end), (end, SIDE - 1)):
            ImageDraw.Draw(canvas).line([(0, 0), corner], fill=255)
    return _grey(np.asarray(canvas) / 255)


def _text() -> Image:
    canvas = pillow.new("L", (SIDE, SIDE), 255)
    words = "\n".join(["Sphinx of black quartz, judge my vow. 0123456789"] * 23)
    ImageDraw.Draw(canvas).multiline_text((2, 2), words, fill=0, spacing=1)
    return _grey(np.asarray(canvas) / 255)


def _smooth() -> Image:
    y, x = np.indices((SMOOTH_SIDE, SMOOTH_SIDE), np.float32) / (SMOOTH_SIDE - 1)
    return np.stack([0.15 + 0.7 * x, 0.2 + 0.5 * y, 0.75 - 0.3 * x - 0.2 * y], axis=2)


def _saturated() -> Image:
    row, column = np.indices((SIDE, SIDE)) // 16
    corner = (row + 3 * column) % 8
    return np.stack([corner >> bit & 1 for bit in range(3)], axis=2).astype(np.float32)


def _noise() -> Image:
    noise = np.random.default_rng(0).normal(0, 0.3, (SIDE, SIDE, 3))
    return np.clip(photo() + noise, 0, 1).astype(np.float32)


def _foreign() -> Image:
    inverted = np.indices((SIDE, SIDE))[0] // STRIPE % 2 == 1
    return np.where(inverted[..., None], 1 - photo(), photo())


def _data(scale: float, offset: float) -> Image:
    """Return the photo as data of another unit; a fit does not depend on it."""
    return photo() * np.float32(scale) + np.float32(offset)


def _grey(plane: NDArray[np.number]) -> Image:
    return np.repeat(plane[..., None], 3, axis=2).astype(np.float32)


def needles(image: Image, count: int, generator: np.random.Generator) -> Shapes:
    """Stretch Gaussians a hundredfold, in all directions: condition 10,000."""
    angle = generator.uniform(0, np.pi, count)
    cos, sin = np.cos(angle), np.sin(angle)
    long, thin = 30.0**2, 0.3**2
    xx, yy = long * cos**2 + thin * sin**2, long * sin**2 + thin * cos**2
    factor = factor_from_covariance(xx, (long - thin) * cos * sin, yy)
    return _anywhere(image, count, generator), factor


def subpixel(image: Image, count: int, generator: np.random.Generator) -> Shapes:
    """Make most Gaussians too narrow for pixel centres; bounds widen them to a quarter pixel."""
    return _anywhere(image, count, generator), _round(count, 0.05)


def heap(image: Image, count: int, generator: np.random.Generator) -> Shapes:
    """Put equal Gaussians on one point."""
    height, width = image.shape[:2]
    return np.tile([width // 2 + 0.5, height // 2 + 0.5], (count, 1)), _round(count, 1.0)


def outside(image: Image, count: int, generator: np.random.Generator) -> Shapes:
    """Put Gaussians around the image, where no pixel sees them; bounds bring them to its edges."""
    height, width = image.shape[:2]
    angle, radius = generator.uniform(0, 2 * np.pi, count), generator.uniform(1, 2, count)
    mean = 0.5 + np.stack([np.cos(angle), np.sin(angle)], axis=1) * radius[:, None]
    return mean * [width, height], _round(count, 2.0)


def _anywhere(image: Image, count: int, generator: np.random.Generator) -> NDArray[np.float64]:
    return generator.uniform(0, [image.shape[1], image.shape[0]], (count, 2))


def _round(count: int, sigma: float) -> NDArray[np.float64]:
    return np.tile([1 / sigma, 0.0, 1 / sigma], (count, 1))


_ALL = (
    Case("photo", photo),  # what the others are compared with
    Case("constant", partial(flat, 0.2, 0.4, 0.6)),  # whole 8-bit levels
    Case("black", partial(flat, 0.0, 0.0, 0.0)),
    Case("white", partial(flat, 1.0, 1.0, 1.0)),
    Case("impulse", _impulse),
    Case("checkerboard", _checkerboard),
    Case("lines", _lines),  # a fan, not smoothed
    Case("text", _text),
    Case("smooth", _smooth),
    Case("saturated", _saturated),  # the eight corners of the RGB cube
    Case("noise", _noise),
    Case("1x512", partial(photo, 512, 1), 128),
    Case("foreign", _foreign),
    *(Case(place.__name__, photo, place=place) for place in (needles, subpixel, heap, outside)),
    Case("fast", photo, rates=10.0),
    Case("long", photo, iterations=10_000),
    Case("seeds", photo, seeds=range(5)),
    *(
        Case(name, partial(_data, *unit), space="data")
        for name, unit in {
            "data": (1, 0),
            "data x 1e-6": (1e-6, 0),
            "data x 1e6": (1e6, 0),
            "data + 1000": (1, 1000),
        }.items()
    ),
)

CASES = {case.name: case for case in _ALL}


def chosen_cases(names: Sequence[str], iterations: int) -> list[Case]:
    """Return cases by name, by default all, with at most this many steps."""
    if unknown := [name for name in names if name not in CASES]:
        raise ValueError(f"case {unknown[0]!r} is unknown; use one of {', '.join(CASES)}")
    chosen = [CASES[name] for name in dict.fromkeys(names or CASES)]
    return [case._replace(iterations=min(case.iterations, iterations)) for case in chosen]
