"""Photos under many lights: planes on shared Gaussians beside planes of pixels, on unseen lights.

A row has "points": setting, planes, bytes of a file with its tables, bytes_per_pixel, and psnr_rgb,
the mean over the photos that were left out; and "exact", the PSNR without any rounding, or for
Gaussians before packing, with the bytes per pixel that are "held" in memory.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image as pillow
from scipy.interpolate import RBFInterpolator

import eigengs_dr as eg
from eigengs_bench import report as fr
from eigengs_bench.rate import AVIF
from eigengs_bench.rows import Job, Row, Task
from eigengs_dr.relight.fit import find_planes, read_photos
from eigengs_dr.relight.lights import functions_at, read_lights

Array = NDArray[Any]

OURS, RELIGHT = "Gaussians", "relight's defaults"
PIXELS = (16, 8)  # pixels per Gaussian; the first is the default
BUDGETS = (0.5, 1.0, 2.0)  # decibels of left-out lights that packing may lose; the first is usual
USUAL = (PIXELS[0], BUDGETS[0])
PLANES = (9, 12, 18)
QUALITIES = (20, 35, 50, 65, 80, 90, 95)
CODEC = AVIF | {"speed": 6}
RIDGE = 1e-3  # of PTM and HSH
# Ranges of all planes that are nearly alike give nearly equal steps of rounding, which is best for
# the sum of squared errors: AVIF takes 20 to 45 % fewer bytes at equal PSNR (two sets).
ALIKE = 0.75


class Lit(NamedTuple):
    """Photos, shape (n, H, W, 3), and their lights (n, 3)."""

    photos: Array
    lights: Array


def sets_of(data: Path) -> list[str]:
    """Name the folders with photos and an ``.lp`` file; a folder Dome is a set with its Test."""
    folders = {path.parent.relative_to(data) for path in data.rglob("*.lp")}
    names = {f.parent if f.name == "Dome" else f for f in folders if f.name != "Test"}
    return sorted(name.as_posix() for name in names)


def photos_of(folder: Path) -> tuple[Lit, Lit]:
    """Load the photos to fit and those that are left out: of Test, or every fifth."""
    if (folder / "Dome").is_dir():
        return _lit(folder / "Dome"), _lit(folder / "Test")
    whole = _lit(folder)
    out = np.arange(len(whole.lights)) % 5 == 2
    return Lit(whole.photos[~out], whole.lights[~out]), Lit(whole.photos[out], whole.lights[out])


def _lit(folder: Path) -> Lit:
    [file] = folder.glob("*.lp")
    names, lights = read_lights(file)
    kept = [k for k, name in enumerate(names) if (folder / name).exists()]
    return Lit(np.stack([eg.load_image(folder / names[k]) for k in kept]), lights[kept])


def run(task: Task, names: Sequence[str] = ()) -> list[Row]:
    """Measure all methods on sets, by default on all in the folder of data."""
    data = Path(task.data or "")
    known = sets_of(data)
    if missing := set(names) - set(known):
        raise ValueError(f"--set {min(missing)}: {data} has {', '.join(known) or 'no sets'}")
    jobs = [job for name in names or known for job in _jobs(task, data / name, name)]
    return task.measure("relight", jobs)


def _jobs(task: Task, folder: Path, name: str) -> Iterator[Job]:
    load = cache(partial(photos_of, folder))

    def work(method: Callable[[Lit, Lit], Row]) -> Row:
        return method(*load())

    for pixels in PIXELS:
        job = {"set": name, "method": OURS, "pixels": pixels, "iterations": task.iterations}
        yield job, partial(work, partial(gaussians, task, pixels))
    for title, method in METHODS.items():
        yield {"set": name, "method": title}, partial(work, method)


# ---------------------------------------------------------------------------------------------
#  Methods
# ---------------------------------------------------------------------------------------------


def seen_psnr(planes: Array, factors: Array, unseen: Lit) -> float:
    """Return the mean PSNR in 8-bit RGB of photos from planes (H, W, K), factors (m, 3, K + 1)."""
    shown = (planes @ f[:, :-1].T + f[:, -1] for f in factors.astype(np.float32))
    pairs = zip(shown, unseen.photos, strict=True)
    return float(np.mean([eg.psnr(np.clip(a, 0, 1), b, "rgb") for a, b in pairs]))


def gaussians(task: Task, pixels: int, seen: Lit, unseen: Lit) -> Row:
    """Fit a model, and pack it with several budgets."""
    height, width = unseen.photos.shape[1:3]
    options: Any = {"gaussians": height * width // pixels, "iterations": task.iterations}
    options["encoding"] = "srgb"
    model = eg.Relightable.fit(*seen, **options, backend=task.backend, progress=False)
    points, count = [], model.planes.channels

    def psnr_of(model: eg.Relightable) -> float:
        picture = eg.picture_of(model.planes).reshape(height, width, count)
        return seen_psnr(picture, model.table.at(unseen.lights), unseen)

    for budget in BUDGETS:
        with TemporaryDirectory() as folder:
            path = Path(folder) / "model.egs"
            size = eg.pack(model, path, max_psnr_drop=budget).bytes
            found = psnr_of(eg.Relightable.load(path, task.backend))
        points.append(_point(budget, count, size, found, height * width))
    planes = model.planes
    arrays = (*planes.mean, *planes.factor, *planes.color, *planes.background)
    held = sum(dr.width(a) * dr.itemsize_v(a) for a in arrays) + 4 * model.table.values.size
    figures = {"table": model.table.kind, "held": held / (height * width)}
    return {"points": points, "exact": psnr_of(model), **figures}


def polynomial(lights: Array) -> Array:
    """Return the functions of a polynomial texture map (Malzbender et al. 2001), (n, 6)."""
    x, y, _ = lights.T
    return np.stack([x * x, y * y, x * y, x, y, np.ones_like(x)], 1)


def harmonics(lights: Array) -> Array:
    """Return nine hemispherical harmonics, (n, 9)."""
    return functions_at("hsh", lights, lights)


def fixed(functions: Callable[[Array], Array], seen: Lit, unseen: Lit) -> Row:
    """Regress each pixel on functions of the light."""
    basis, shape = functions(seen.lights), unseen.photos.shape[1:3]
    normal = basis.T @ basis + RIDGE * np.eye(basis.shape[1])
    right = np.tensordot(basis, seen.photos, (0, 0)).reshape(len(normal), -1)
    found = np.linalg.solve(normal, right).reshape(-1, *shape, 3)
    planes = np.moveaxis(found, 0, 2).reshape(*shape, -1).astype(np.float32)
    values = functions(unseen.lights)  # a plane belongs to one colour
    factors = np.einsum("mb,cd->mcbd", values, np.eye(3)).reshape(len(values), 3, -1)
    return _measured(planes, np.pad(factors, ((0, 0), (0, 0), (0, 1))), unseen, 0)


def defaults(seen: Lit, unseen: Lit) -> Row:
    """Take the defaults of relight: 9 principal components, RBF between lights, JPEG 95."""
    found = find_planes(read_photos(*seen, "srgb"), PLANES[0])
    values = found.table.values
    spline = RBFInterpolator(seen.lights[:, :2], values.reshape(len(values), -1), smoothing=1e-3)
    factors = spline(unseen.lights[:, :2]).reshape(-1, *values.shape[1:])
    size = values.size + 6 * len(values)
    return _measured(found.images, factors, unseen, size, qualities=(95,))


def components(kind: str, tuned: bool, seen: Lit, unseen: Lit) -> Row:
    """Code our planes and our table, as pixels: with any number of planes, at any quality."""
    rows = []
    for count in PLANES:
        found = find_planes(read_photos(*seen, "srgb"), count)
        size = found.table.values.size + 6 * len(seen.lights)
        factors = found.table.at(unseen.lights)
        rows.append(_measured(found.images, factors, unseen, size, kind, tuned))
    return {"points": [point for row in rows for point in row["points"]]}


METHODS: dict[str, Callable[[Lit, Lit], Row]] = {
    RELIGHT: defaults,
    "PTM": partial(fixed, polynomial),
    "HSH": partial(fixed, harmonics),
    "JPEG planes": partial(components, "JPEG", False),
    "JPEG planes, tuned": partial(components, "JPEG", True),
    "AVIF planes": partial(components, "AVIF", False),
    "AVIF planes, tuned": partial(components, "AVIF", True),
}


def _measured(
    planes: Array,
    factors: Array,
    unseen: Lit,
    tables: int,
    kind: str = "JPEG",
    tuned: bool = False,
    qualities: Sequence[int] = QUALITIES,
) -> Row:
    """Code planes; a table takes a byte a number, and each plane two floats for its range."""
    height, width, count = planes.shape
    points, tables = [], tables + 8 * count
    for quality in qualities:
        size, decoded = coded(planes, kind, tuned, quality)
        found = seen_psnr(decoded, factors, unseen)
        points.append(_point(quality, count, size + tables, found, height * width))
    return {"points": points, "exact": seen_psnr(planes, factors, unseen)}


def _point(setting: float, count: int, size: int, found: float, pixels: int) -> Row:
    figures = {"setting": setting, "planes": count, "bytes": size, "psnr_rgb": found}
    return {**figures, "bytes_per_pixel": size / pixels}


def coded(planes: Array, kind: str, tuned: bool, quality: int) -> tuple[int, Array]:
    """Code planes in 8 bits; return the bytes and what they decode to.

    By default three planes are the colours of a picture, each in its range. Tuned, each plane is a
    picture of its own, and the ranges are nearly alike.
    """
    low, high = planes.min((0, 1)), planes.max((0, 1))
    span = np.maximum(high - low, 1e-9)
    wide = span.max() ** ALIKE * span ** (1 - ALIKE) if tuned else span
    low = (low + high - wide) / 2
    codes = np.round((planes - low) / wide * 255).clip(0, 255).astype(np.uint8)
    if tuned and kind == "AVIF":  # in one file, below each other
        size, found = _file(np.concatenate(list(np.moveaxis(codes, 2, 0))), kind, quality, CODEC)
        found = np.moveaxis(found.reshape(-1, *codes.shape[:2]), 0, 2)
    else:
        jpeg = {"optimize": True, **({"keep_rgb": True} if tuned else {"subsampling": 0})}
        options = CODEC if kind == "AVIF" else jpeg
        parts = (codes[..., k : k + 3] for k in range(0, codes.shape[2], 3))
        sizes, pictures = zip(*(_file(p, kind, quality, options) for p in parts), strict=True)
        size, found = sum(sizes), np.concatenate(pictures, axis=2)
    return size, (found.astype(np.float32) / 255 * wide + low).astype(np.float32)


def _file(pixels: NDArray[np.uint8], kind: str, quality: int, options: Any) -> tuple[int, Any]:
    """Encode a picture; return the bytes, and the pixels that they decode to."""
    file, picture = BytesIO(), pillow.fromarray(np.ascontiguousarray(pixels))
    picture.save(file, kind, quality=quality, **options)
    return file.tell(), np.asarray(pillow.open(file).convert(picture.mode))


# ---------------------------------------------------------------------------------------------
#  Table and chart
# ---------------------------------------------------------------------------------------------

STYLES = {
    OURS: (fr.BLUE, "o-"),
    RELIGHT: (fr.INK, "*"),
    "PTM": (fr.GREY, ":"),
    "HSH": (fr.GREY, "-."),
    "JPEG planes": (fr.RED, "--"),
    "JPEG planes, tuned": (fr.ORANGE, "-"),
    "AVIF planes": (fr.PINK, "--"),
    "AVIF planes, tuned": (fr.GREEN, "-"),
}
CODED = tuple(STYLES)[4:]


def at_level(points: pd.DataFrame, level: float) -> tuple[float, float]:
    """Return the bytes per pixel at a PSNR, and how far above it they are.

    Beyond the ends of a curve, it is the nearest end, which is not at this PSNR.
    """
    line = fr.best(points, "bytes_per_pixel")
    low, high = line.psnr_rgb.iloc[0], line.psnr_rgb.iloc[-1]
    if low < level < high:
        return fr.smallest(dict(zip(line.bytes_per_pixel, line.psnr_rgb, strict=True)), level), 0.0
    end = line.iloc[0 if level <= low else -1]
    return end.bytes_per_pixel, end.psnr_rgb - level


def comparison(points: pd.DataFrame, exact: pd.DataFrame) -> dict[str, float]:
    """Compare the methods on one set, see `summarize`."""
    by_method = dict(iter(points.groupby("method")))
    ours = by_method[OURS]
    usual = ours[(ours.pixels == USUAL[0]) & (ours.setting == USUAL[1])].iloc[0]
    found = {"ours": usual.psnr_rgb, "bytes": usual.bytes_per_pixel}
    theirs = by_method[RELIGHT].iloc[0]
    size, gap = at_level(ours, theirs.psnr_rgb)
    found |= {RELIGHT: size / theirs.bytes_per_pixel, "gap": gap}
    for method in CODED:  # a curve that ends below ours is compared at its end
        found[method] = usual.bytes_per_pixel / at_level(by_method[method], usual.psnr_rgb)[0]
    named = exact.set_index("method").exact
    found["better"] = max(named[RELIGHT], named["HSH"])
    fit = exact[exact.pixels == USUAL[0]].iloc[0]
    return found | {"held": fit.held, "exact": fit.exact - found["better"]}


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Lay out the bytes of ours over those of each method at equal PSNR, and draw all points."""
    points, exact = fr.frame_of(rows, "points"), fr.frame_of(rows)
    sets = {
        str(name): comparison(part, exact[exact.set == name])
        for name, part in points.groupby("set", sort=False)
        if set(STYLES) <= set(part.method)
    }
    if not sets:  # a run that was stopped has not measured all methods
        return fr.Section()
    frame = pd.DataFrame(sets).T
    ratios = [RELIGHT, *CODED]
    middle = frame.median()
    lines = [
        (
            name,
            f"{fr.number(row.ours)}; {fr.number(row.bytes, 2)}",
            f"{fr.number(row[RELIGHT], 2)} ({row.gap:+.1f} dB)",
            *(fr.number(row[method], 2) for method in CODED),
            f"{row.exact:+.1f}",
            fr.number(row.held, 1),
        )
        for name, row in [*frame.iterrows(), ("median", middle)]
    ]
    caption = (
        "Bytes of packed Gaussians over those of planes of pixels at equal PSNR of photos that "
        "were left out (in brackets where no size of ours meets it); what Gaussians before packing "
        "reach above the better of 9 principal components with RBF and 27 planes of HSH, both "
        "without rounding; bytes per pixel in memory"
    )
    columns = ("set", "dB; bytes per pixel", *ratios, "PSNR, dB", "in memory")
    figures = {name: fr.number(middle[name], 2) for name in ("bytes", "held", "exact")}
    figures |= {f"over_{k}": fr.number(middle[name], 2) for k, name in enumerate(ratios)}
    charts = {"relight": _chart(points)}
    return fr.Section([fr.table(caption, columns, lines, "sets")], charts, figures)


def _chart(points: pd.DataFrame) -> Figure:
    """Draw PSNR over bytes per pixel: a panel for each set."""
    names = points.set.unique()
    across = min(4, len(names))
    down = -(-len(names) // across)
    figure = fr.new_figure(3 * across, 2.8 * down, "Photos under lights that were left out")
    axes = figure.subplots(down, across, squeeze=False).ravel()
    for axis, name in zip(axes, names, strict=False):
        for method, (color, style) in STYLES.items():
            some = points[(points.set == name) & (points.method == method)]
            line = fr.best(some, "bytes_per_pixel")
            x, y = line.bytes_per_pixel, line.psnr_rgb
            axis.plot(x, y, style, color=color, ms=4, label=method)
        axis.set_title(name, fontsize=8)
        fr.label_axes(axis, "bytes per pixel", "PSNR in RGB / dB", legend=False)
    for axis in axes[len(names) :]:
        axis.remove()
    fr.legend_below(figure, axes[0], 4)
    return figure
