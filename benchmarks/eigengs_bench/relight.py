"""Photos under many lights: planes on shared Gaussians beside planes of pixels, on unseen lights.

A row has "points": setting, planes, bytes of a file with its tables, bytes_per_pixel, and psnr_rgb,
the mean over the photos that were left out; and "exact", the PSNR without any rounding, or for
Gaussians before packing, with the bytes per pixel that are "held" in memory. Of Gaussians and of a
network, "seconds" are those of the fit, and "picture_seconds" those of one picture.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache, partial
from importlib import import_module
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
from eigengs_dr.relight.packed import table_bytes

Array = NDArray[Any]

OURS, RELIGHT, SPLINES = "Gaussians", "relight", "thin plates"
NEURAL = "NeuralRTI, reproduced"
DROPS = (None, 0.6, 1.2, 1.7, 2.4, 3.4, 4.8)  # decibels that a fit may lose; None is the default
BUDGETS = (0.5, 0.25, 1.0, 2.0)  # decibels that packing may lose; the first is its default
TABLE_ERROR = 0.01  # of the error of left-out photos: 0.04 dB, which rivals do not lose
PLANES = (3, 6, 9, 12, 18, 24)  # and as many as a model has by default, which is the most
RIDGE = 1e-3  # of HSH
# Ranges of all planes that are nearly alike give nearly equal steps of rounding, which is best for
# the sum of squared errors: AVIF takes 20 to 45 % fewer bytes at equal PSNR (two sets).
ALIKE = 0.75


class Codec(NamedTuple):
    """Pillow's name and options; planes are pictures of 3 in their ranges, or grey and alike."""

    kind: str
    options: dict[str, Any]
    channels: int = 1
    qualities: tuple[int, ...] = (4, 8, 14, 20, 30, 45, 65, 85)


PLAIN = Codec("PPM", {}, qualities=(0,))
IN_COLORS = Codec("JPEG", {"optimize": True, "subsampling": 0}, 3)  # relight's files
GREY = {
    "JPEG planes": Codec("JPEG", {"optimize": True}),
    "AVIF planes": Codec("AVIF", AVIF | {"subsampling": "4:0:0"}),
    "JPEG XL planes": Codec("JXL", {"effort": 7}),
}


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
    paths, lights = read_lights(file, folder)
    return Lit(np.stack([eg.load_image(path) for path in paths]), lights)


def run(task: Task, names: Sequence[str] = (), neural: bool = False) -> list[Row]:
    """Measure all methods on sets, by default on all in the folder of data."""
    data = Path(task.data or "")
    known = sets_of(data)
    if missing := set(names) - set(known):
        raise ValueError(f"--set {min(missing)}: {data} has {', '.join(known) or 'no sets'}")
    jobs = [job for name in names or known for job in _jobs(task, data / name, name, neural)]
    return task.measure("relight", jobs)


def _jobs(task: Task, folder: Path, name: str, neural: bool) -> Iterator[Job]:
    load = cache(partial(photos_of, folder))

    def work(method: Callable[[Lit, Lit], Row]) -> Row:
        return method(*load())

    for drop in DROPS:
        job = {"set": name, "method": OURS, "drop": drop, "iterations": task.iterations}
        yield job, partial(work, partial(gaussians, task, drop))
    for title, method in (METHODS | ({NEURAL: network} if neural else {})).items():
        yield {"set": name, "method": title}, partial(work, method)


# ---------------------------------------------------------------------------------------------
#  Methods
# ---------------------------------------------------------------------------------------------


def seen_psnr(pictures: Iterable[Array], unseen: Lit) -> float:
    """Return the mean PSNR in 8-bit RGB of pictures of the photos that were left out.

    At most 59 dB count, the error of rounding to 8 bits: a flat colour may be met exactly.
    """
    pairs = zip(pictures, unseen.photos, strict=True)
    return float(np.mean([min(59.0, eg.psnr(np.clip(a, 0, 1), b, "rgb")) for a, b in pairs]))


def mixed(factors: Array, planes: Array) -> Iterator[Array]:
    """Mix planes (H, W, K) by factors (m, 3, K + 1) of lights."""
    return (planes @ f[:, :-1].T + f[:, -1] for f in factors.astype(np.float32))


def gaussians(task: Task, drop: float | None, seen: Lit, unseen: Lit) -> Row:
    """Fit a model, and pack it with several budgets."""
    height, width = unseen.photos.shape[1:3]
    options: Any = {"iterations": task.iterations, "backend": task.backend}
    started = time.perf_counter()
    model = eg.Relightable.fit(
        *seen, max_psnr_drop=drop, encoding="srgb", progress=False, **options
    )
    seconds = time.perf_counter() - started
    points, count = [], model.planes.channels

    def psnr_of(model: eg.Relightable) -> float:
        planes = eg.picture_of(model.planes).reshape(height, width, count)
        return seen_psnr(mixed(model.table.at(unseen.lights), planes), unseen)

    for budget in BUDGETS:
        with TemporaryDirectory() as folder:
            path = Path(folder) / "model.egs"
            size = eg.pack(model, path, max_psnr_drop=budget).bytes
            found = psnr_of(eg.Relightable.load(path, task.backend))
        points.append(_point(budget, count, size, found, height * width))
    planes = model.planes
    arrays = (*planes.mean, *planes.factor, *planes.color, *planes.background)
    held = sum(dr.width(a) * dr.itemsize_v(a) for a in arrays) + 4 * model.table.values.size
    shown = (eg.picture_of(model.relight(light)) for light in unseen.lights)
    figures = {"table": model.table.kind, "held": held / (height * width), "seconds": seconds}
    figures["picture_seconds"] = _seconds_of_next(shown)
    return {"points": points, "exact": psnr_of(model), **figures}


def _seconds_of_next(pictures: Iterator[Array]) -> float:
    """Time the second picture: the first compiles."""
    next(pictures)
    started = time.perf_counter()
    next(pictures)
    return time.perf_counter() - started


def hemispherical(seen: Lit, unseen: Lit) -> Row:
    """Regress each pixel on nine hemispherical harmonics of the light."""
    basis, values = (functions_at("hsh", lit.lights, lit.lights) for lit in (seen, unseen))
    normal, shape = basis.T @ basis + RIDGE * np.eye(basis.shape[1]), unseen.photos.shape[1:3]
    right = np.tensordot(basis, seen.photos, (0, 0)).reshape(len(normal), -1)
    found = np.linalg.solve(normal, right).reshape(-1, *shape, 3)
    planes = np.moveaxis(found, 0, 2).reshape(*shape, -1).astype(np.float32)
    # A plane belongs to one colour.
    factors = np.einsum("mb,cd->mcbd", values, np.eye(3)).reshape(len(values), 3, -1)
    show = partial(mixed, np.pad(factors, ((0, 0), (0, 0), (0, 1))))
    return _measured(planes, show, unseen, 0, IN_COLORS)


def bells(seen: Lit, values: Array, lights: Array) -> Array:
    """Interpolate as relight does: normalised Gaussians of the distance.

    Their width is that of its window; the 0.125 of its command line, for 100 photos, shows the ten
    sets 1.2 dB less in the median.
    """
    square = ((lights[:, None] - seen.lights) ** 2).sum(2)
    weights = np.exp(-square / (12.5 / len(values)) ** 2)
    return np.tensordot(weights / weights.sum(1, keepdims=True), values, 1)


def splines(seen: Lit, values: Array, lights: Array) -> Array:
    """Interpolate by thin plates."""
    spline = RBFInterpolator(seen.lights[:, :2], values.reshape(len(values), -1), smoothing=1e-3)
    return spline(lights[:, :2]).reshape(-1, *values.shape[1:])


def in_colors(between: Callable[[Lit, Array, Array], Array], seen: Lit, unseen: Lit) -> Row:
    """Take the planes and files of relight: 9 principal components, JPEG of quality 95."""
    found = find_planes(read_photos(*seen, "srgb"), 9)
    values = found.table.values
    show = partial(mixed, between(seen, values, unseen.lights))
    size = values.size + 6 * len(values)
    return _measured(found.images, show, unseen, size, IN_COLORS._replace(qualities=(95,)))


def grey(codec: Codec, seen: Lit, unseen: Lit) -> Row:
    """Code our planes and our table, as grey pixels: as many as ours, and fewer."""
    most = find_planes(read_photos(*seen, "srgb")).images.shape[2]
    points = []
    for count in (*(number for number in PLANES if number < most), most):
        found = find_planes(read_photos(*seen, "srgb"), count)
        squares, error = np.square(found.images).mean((0, 1)), TABLE_ERROR * found.left_out.mean()
        size = len(table_bytes(found.table, squares, error, np.nan, 1.0))
        show = partial(mixed, found.table.at(unseen.lights))
        row = _measured(found.images, show, unseen, size, codec)
        points += row["points"]
    return {"points": points, "exact": row["exact"]}


def network(seen: Lit, unseen: Lit) -> Row:
    """Train a network; its codes are plain bytes, or grey pictures. Weights take 2 bytes."""
    trained = import_module("eigengs_bench.neural").train(*seen)
    show = partial(trained.shown, lights=unseen.lights)
    codecs = (PLAIN, PLAIN._replace(kind="PNG"), GREY["AVIF planes"])
    rows = [_measured(trained.codes, show, unseen, 2 * trained.weights, c) for c in codecs]
    times = {"seconds": trained.seconds, "picture_seconds": _seconds_of_next(show(trained.codes))}
    return {**rows[0], "points": [point for row in rows for point in row["points"]], **times}


METHODS: dict[str, Callable[[Lit, Lit], Row]] = {
    RELIGHT: partial(in_colors, bells),
    SPLINES: partial(in_colors, splines),
    "HSH": hemispherical,
    **{title: partial(grey, codec) for title, codec in GREY.items()},
}


def _measured(
    planes: Array, show: Callable[[Array], Iterable[Array]], unseen: Lit, tables: int, codec: Codec
) -> Row:
    """Code planes beside tables of some bytes; each plane takes two floats for its range."""
    height, width, count = planes.shape
    points, tables = [], tables + 8 * count
    for quality in codec.qualities:
        size, decoded = coded(planes, codec, quality)
        found = seen_psnr(show(decoded), unseen)
        points.append(_point(quality, count, size + tables, found, height * width))
    return {"points": points, "exact": seen_psnr(show(planes), unseen)}


def _point(setting: float, count: int, size: float, found: float, pixels: int) -> Row:
    figures = {"setting": setting, "planes": count, "bytes": size, "psnr_rgb": found}
    return {**figures, "bytes_per_pixel": size / pixels}


def coded(planes: Array, codec: Codec, quality: int) -> tuple[int, Array]:
    """Code planes in 8 bits, below each other; return the bytes and what they decode to."""
    height, width, count = planes.shape
    low, high = planes.min((0, 1)), planes.max((0, 1))
    span = np.maximum(high - low, 1e-9)
    wide = span.max() ** ALIKE * span ** (1 - ALIKE) if codec.channels == 1 else span
    low = (low + high - wide) / 2
    codes = np.round((planes - low) / wide * 255).clip(0, 255).astype(np.uint8)
    across = (height, width, count // codec.channels, codec.channels)
    stacked = np.moveaxis(codes.reshape(across), 2, 0).reshape(-1, width, codec.channels)
    file, picture = BytesIO(), pillow.fromarray(stacked.squeeze())
    picture.save(file, codec.kind, quality=quality, **codec.options)
    size, read = file.tell(), np.asarray(pillow.open(file).convert(picture.mode))
    found = np.moveaxis(read.reshape(across[2], *across[:2], across[3]), 0, 2).reshape(codes.shape)
    return size, (found.astype(np.float32) / 255 * wide + low).astype(np.float32)


# ---------------------------------------------------------------------------------------------
#  Tables and chart
# ---------------------------------------------------------------------------------------------

STYLES = {
    OURS: (fr.BLUE, "o-"),
    RELIGHT: (fr.INK, "*"),
    SPLINES: (fr.INK, "+"),
    "HSH": (fr.GREY, "-."),
    "JPEG planes": (fr.ORANGE, "-"),
    "AVIF planes": (fr.GREEN, "-"),
    "JPEG XL planes": (fr.SKY, "-"),
    NEURAL: (fr.RED, "--"),
}
RIVALS = (RELIGHT, SPLINES, *GREY, NEURAL)
LEVELS = 5  # PSNRs at which the sizes of two curves are compared


def ratios(ours: pd.DataFrame, other: pd.DataFrame) -> pd.Series:
    """Return the bytes of ours over those of another curve, at PSNRs that both reach.

    They lie evenly between the ends of what the curves share. If ours begins above the end of the
    other, it is the ratio of these ends, a bound; if it ends below, there is none.
    """
    curves = [fr.best(points, "bytes_per_pixel") for points in (ours, other)]
    mine, others = (curve.set_index("bytes_per_pixel").psnr_rgb for curve in curves)
    if mine.min() > others.max():
        return pd.Series([mine.index[0] / others.index[-1]])
    low, high = max(mine.min(), others.min()), min(mine.max(), others.max())
    levels: Array = np.linspace(low, high, LEVELS + 2)[1:-1] if low <= high else np.empty(0)
    sizes = [np.exp(np.interp(levels, c, np.log(c.index))) for c in (mine, others) if len(levels)]
    return pd.Series(np.divide(*sizes) if sizes else [], dtype=float)


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Lay out the bytes of ours over those of each method at equal PSNR, and draw all points."""
    points = fr.frame_of(rows, "points")
    groups = points.groupby("set", sort=False)
    measured = {str(name): dict(iter(part.groupby("method"))) for name, part in groups}
    sets = {k: m for k, m in measured.items() if OURS in m and len(_usual(m[OURS]))}
    if not sets:  # a run that was stopped has not measured the default
        return fr.Section()
    frame = pd.DataFrame([_figures_of(methods) for methods in sets.values()], list(sets))
    # The chart alone has splines: another way to read the planes of relight, not another rival.
    rivals = [rival for rival in RIVALS if frame[rival].any() and rival != SPLINES]
    lines = [
        (
            name,
            f"{fr.number(row.psnr)}; {fr.number(row.bytes, 2)}",
            *(f"{row[k]:.2f} ({row[k, 'most']:.2f})".replace("nan (nan)", "") for k in rivals),
            f"{row.ahead:+.1f}",
            fr.number(row.held, 1),
        )
        for name, row in [*frame.iterrows(), ("median", frame.median())]
    ]
    caption = (
        "Packed Gaussians, by default; their bytes over those of planes of pixels at five PSNRs of "
        "left-out photos, between the ends of both curves: median (largest); or, if ours shows "
        "more at every size, its smallest over their largest; unpacked, above the best of 9 "
        "principal components and 27 planes of HSH; bytes per pixel in memory"
    )
    columns = ("set", "dB; bytes per pixel", *rivals, "PSNR, dB", "in memory")
    figures = {name: fr.number(frame[name].median(), 2) for name in ("bytes", "held", "ahead")}
    for rival in rivals:
        key = rival.removesuffix(" planes").replace(" ", "_")
        figures[f"over_{key}"] = fr.number(frame[rival].median(), 2)
        figures[f"worst_{key}"] = fr.number(frame[rival].max(), 2)
    tables = [fr.table(caption, columns, lines, "sets"), _networks(points)]
    by_ratio = frame.index[frame["AVIF planes"].argsort()]
    shown = by_ratio[np.linspace(0, len(sets) - 1, min(4, len(sets))).round().astype(int)]
    return fr.Section(tables, {"relight": _chart(points[points.set.isin(shown)])}, figures)


def _usual(ours: pd.DataFrame) -> pd.DataFrame:
    """Keep the points of a fit and a pack without options."""
    return ours[ours["drop"].isna() & (ours.setting == BUDGETS[0])]


def _figures_of(methods: dict[str, pd.DataFrame]) -> dict[Any, float]:
    """Return the figures of our default on a set, and medians and largest of `ratios`."""
    usual = _usual(methods[OURS]).iloc[0]
    found: Any = {"psnr": usual.psnr_rgb, "bytes": usual.bytes_per_pixel, "held": usual.held}
    unrounded = [methods[k].exact.iloc[0] for k in (RELIGHT, SPLINES, "HSH") if k in methods]
    found["ahead"] = usual.exact - max(unrounded, default=np.nan)
    for rival in RIVALS:
        over = ratios(methods[OURS], methods[rival]) if rival in methods else pd.Series([np.nan])
        found |= {rival: over.median(), (rival, "most"): over.max()}
    return found


def _networks(points: pd.DataFrame) -> fr.Table:
    """Lay out networks beside our default on their sets."""
    some = points[points.set.isin(points.set[points.method == NEURAL])]
    plain = some[(some.method == NEURAL) & (some.setting == 0)]
    both = pd.concat([_usual(some[some.method == OURS]), plain]).sort_values("set", kind="stable")
    columns = {
        "dB": ("psnr_rgb", fr.mean),
        "bytes per pixel": ("bytes_per_pixel", fr.median),
        "unrounded, dB": ("exact", fr.mean),
        "s": ("seconds", fr.mean),
        "s per picture": ("picture_seconds", fr.median),
    }
    caption = (
        "Our default, and nine codes of 8 bits with their decoder: PSNR of photos that were left "
        "out, bytes per pixel, PSNR without rounding, seconds of the fit and of a picture"
    )
    return fr.grouped(caption, both, ["set", "method"], columns)._replace(name="networks")


def _chart(points: pd.DataFrame) -> Figure:
    """Draw PSNR over bytes per pixel: a panel for each set."""
    names = points.set.unique()
    down = -(-len(names) // 2)
    figure = fr.new_figure(9, 3 * down, "Photos under lights that were left out")
    axes = figure.subplots(down, 2, squeeze=False).ravel()
    for axis, name in zip(axes, names, strict=False):
        for method in (method for method in STYLES if method in set(points.method)):
            some = points[(points.set == name) & (points.method == method)]
            line, (color, style) = fr.best(some, "bytes_per_pixel"), STYLES[method]
            x, y = line.bytes_per_pixel, line.psnr_rgb
            axis.plot(x, y, style, color=color, ms=4, label=method)
        axis.set_title(name, fontsize=8)
        fr.label_axes(axis, "bytes per pixel", "PSNR in RGB / dB", legend=False)
    for axis in axes[len(names) :]:
        axis.remove()
    fr.legend_below(figure, axes[0], 4)
    return figure
