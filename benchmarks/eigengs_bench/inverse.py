"""Recovery of textures from photos by texels, a pyramid of texels, or Gaussians.

A step renders one camera with a few samples per pixel. Texels descend in a loop of `mi.render`, the
pyramid and Gaussians by `photo_loss`, which Dr.Jit replays. PSNRs are those of pictures by cameras
that took no photo, and of maps, where photos show them and elsewhere. The parameters of a pyramid
are differences of texels to the next coarser level (Weier et al. 2025, doi 10.1145/3730855), so
coarse ones move many texels.
"""

import gc
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import accumulate
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from matplotlib.figure import Figure

import eigengs_bench.report as fr
import eigengs_dr as eg
from eigengs_bench.clock import Image
from eigengs_bench.names import SUBJECTS_OF_DATA, SUBJECTS_OF_SAMPLES
from eigengs_bench.report import Section, Table, number, table
from eigengs_bench.rows import Job, Row, Task
from eigengs_bench.subjects import (
    SPACES,
    SPP,
    SUBJECTS,
    Maps,
    Scene,
    Subject,
    grey,
    photos_of,
    scene_of,
)
from eigengs_dr.cli.scene import load_mitsuba
from eigengs_dr.image.color import to_coded

STEPS_OF_MAPS = 240  # of the fits whose maps are shown, if there are such
WARM_UP = 40  # steps of a fit that compiles, as many as the first stage of a fit has
LAST_RATE, MOMENTUM = 0.05, 0.5  # share to which rates fall by a cosine; of Adam, best for all
RATES = {"texels": 0.02, "pyramid": 0.004}  # best for "coffee", a photo of no scene here
COARSEST = 4  # texels a side


class Unknown(NamedTuple):
    """The values to optimise with their rate, and the texels of the maps that they make."""

    start: dict[str, Any]
    rate: float
    texels_of: Callable[[Any], dict[str, Any]]


def levels(mi: Any, scene: Scene, method: str) -> Unknown:
    """Describe maps by texels; those of a pyramid are added to the next coarser sum at its size."""
    sides, start = [scene.subject.texels], {}
    while method == "pyramid" and sides[-1] > COARSEST:
        sides.append(sides[-1] // 2)
    for name in scene.maps:
        color = grey(scene.kind, name)[0, 0]
        for side in sides:
            start[f"{name}{side}"] = dr.zeros(mi.TensorXf, (side, side, len(color)))
        start[f"{name}{sides[-1]}"] += mi.TensorXf(color[None, None])

    def texels_of(values: Any) -> dict[str, Any]:
        result = {}
        for name in scene.maps:
            total = values[f"{name}{sides[-1]}"]
            for side in sides[-2::-1]:
                size = (side, side, total.shape[2])
                total = dr.resample(total, size, "linear", boundary="nearest")
                total = total + values[f"{name}{side}"]
            result[name] = total
        return result

    return Unknown(start, RATES[method], texels_of)


def fit(mi: Any, scene: Scene, steps: int) -> Row:
    """Recover maps by `eg.fit` of a `photo_loss`; a short fit before it compiles the kernels."""
    names = list(scene.maps)
    spaces = {name: SPACES[name] for name in names}
    size = (scene.subject.texels, scene.subject.texels)
    for iterations in (WARM_UP, steps):
        gc.collect()
        loss = loss_of(scene, scene.load(mi))
        result = eg.fit(
            loss=loss,
            size=size,
            space=spaces,
            iterations=iterations,
            seed=scene.seed,
            progress=False,
        )
        dr.sync_thread()
    rendering = eg.render(result.gaussians).numpy()
    ends = np.cumsum([scene.maps[name].shape[2] for name in names])[:-1]
    maps = dict(zip(names, np.split(np.clip(rendering, 0, 1), ends, axis=2), strict=True))
    count = sum(array.size for array in result.gaussians.to_arrays().values())
    row = {"seconds": result.seconds, "parameters": count, "gaussians": len(result.gaussians)}
    return row | judge(mi, scene, maps)


def descend(mi: Any, scene: Scene, method: str, steps: int) -> Row:
    """Descend by Adam; the seconds leave out the first step, which compiles and records."""
    unknown = levels(mi, scene, method)
    loaded, keys = scene.load(mi), scene.subject.keys
    parameters, values = mi.traverse(loaded), mi.ad.Adam(1.0, unknown.start, beta_1=MOMENTUM)
    photos = [mi.TensorXf(photo) for photo in scene.photos[: scene.cameras]]
    replayed = loss_of(scene, loaded).function if method == "pyramid" else None

    def error(maps: Mapping[str, Any], step: int) -> Any:
        if replayed:
            return replayed(maps, step)
        parameters.update({f"{keys[name]}.data": values for name, values in maps.items()})
        camera, seed = step % scene.cameras, (scene.seed << 16) + step
        rendered = mi.render(loaded, parameters, sensor=camera, spp=scene.spp, seed=seed)
        return dr.mean(dr.square(rendered - photos[camera]), axis=None)

    started = 0.0
    for step in range(steps):
        rate = LAST_RATE + (1 - LAST_RATE) * (0.5 + 0.5 * math.cos(math.pi * step / steps))
        values.set_learning_rate(rate * unknown.rate)
        dr.backward(error(unknown.texels_of(values), step))
        values.step()
        if not step:
            dr.sync_thread()
            started = time.perf_counter()
    dr.sync_thread()
    seconds = time.perf_counter() - started
    maps = {name: values.numpy() for name, values in unknown.texels_of(values).items()}
    count = sum(dr.width(level) for level in unknown.start.values())
    return {"seconds": seconds, "parameters": count} | judge(mi, scene, maps)


def loss_of(scene: Scene, loaded: Any) -> eg.Loss:
    """Return the loss of the photos of a scene, loaded by Mitsuba."""
    from eigengs_dr.plugins import photo_loss

    photos, cameras = scene.photos[: scene.cameras], range(scene.cameras)
    names = dict(scene.subject.keys)
    return photo_loss(loaded, names, photos, sensors=cameras, spp=scene.spp, seed=scene.seed)


def judge(mi: Any, scene: Scene, maps: Maps) -> Row:
    """Return psnr_rgb of the cameras that took no photo, and PSNRs of the maps.

    That of a map "where seen" weighs texels by what the photos say of them, `NAME_unseen` is that
    of texels on which no photo depends, and `NAME_constant` that of the best constant where seen.
    """
    views = photos_of(mi, scene.load(mi, maps), scene.cameras)
    coded = [
        to_coded(np.maximum(np.concatenate(pictures), 0))
        for pictures in (views, scene.photos[scene.cameras :])
    ]
    row: Row = {"psnr_rgb": eg.psnr(coded[0], coded[1])}
    unseen = np.float32(scene.seen == 0)
    for name, true in scene.maps.items():
        mean = np.average(true.reshape(-1, true.shape[2]), axis=0, weights=scene.seen.ravel())
        row[name] = _psnr(name, maps[name], true, scene.seen)
        row[f"{name}_unseen"] = _psnr(name, maps[name], true, unseen) if unseen.any() else None
        row[f"{name}_constant"] = _psnr(name, np.broadcast_to(mean, true.shape), true, scene.seen)
    return row


def _psnr(name: str, picture: Image, true: Image, weights: Image) -> float:
    pair = [np.clip(values, 0, 1) for values in (picture, true)]
    if SPACES[name] == "linear":
        pair = [to_coded(values) for values in pair]
    error = np.mean(np.square(pair[0] - pair[1]), axis=2)
    return float(-10 * np.log10(np.average(error, weights=weights)))


def run(task: Task, subjects: Sequence[str], seeds: int) -> list[Row]:
    """Recover the maps of subjects, by default all whose images are there, for each seed."""
    known = SUBJECTS_OF_SAMPLES + (SUBJECTS_OF_DATA if task.data else ())
    if missing := set(subjects) - set(known):
        raise ValueError(f"--scene {min(missing)} needs DATA, the folder of painting.xml")
    subjects = subjects or known
    return task.measure("inverse", _jobs(task, subjects, seeds))


def _jobs(task: Task, subjects: Sequence[str], seeds: int) -> Iterator[Job]:
    mi = load_mitsuba("cuda_ad_rgb" if task.backend == "cuda" else "llvm_ad_rgb", quiet=False)
    cases = [(kind, count) for kind in subjects for count in SUBJECTS[kind].cameras]
    for kind, count in cases:
        for seed in range(seeds):
            for steps, spp, method in _descents(SUBJECTS[kind]):
                job = {"scene": kind, "cameras": count, "method": method, "steps": steps}
                job |= {"spp": spp, "seed": seed}
                yield job, partial(recover, mi, task.data, job)


def _descents(subject: Subject) -> Iterator[tuple[int, int, str]]:
    """Yield steps, samples and method; rivals also take half as many steps more than any fit."""
    for spp, fits in subject.runs.items():
        rivals = RIVALS if spp == first_spp(subject) else ("pyramid",)
        for steps in (*fits, fits[-1] * 3 // 2):
            yield from ((steps, spp, method) for method in rivals)
            if steps in fits:
                yield steps, spp, "fit"


def first_spp(subject: Subject) -> int:
    """Return the samples of a pixel of the descents that all methods take."""
    return next(iter(subject.runs))


def recover(mi: Any, data: Path | None, job: Row) -> Row:
    """Recover the maps of a scene by a method; return seconds, parameters and PSNRs."""
    gc.collect()  # Mitsuba traces the plugins of every scene that is still there
    scene = scene_of(mi, job["scene"], job["cameras"], data)
    scene = scene._replace(spp=job["spp"], seed=job["seed"])
    if job["method"] == "fit":
        return fit(mi, scene, job["steps"])
    return descend(mi, scene, job["method"], job["steps"])


# ---------------------------------------------------------------------------------------------
#  Tables and a chart
# ---------------------------------------------------------------------------------------------

METHODS = {"texels": fr.GREY, "pyramid": fr.RED, "fit": fr.BLUE}
MARKERS = dict(zip(METHODS, "vsP", strict=True))
RIVALS = ("texels", "pyramid")
SLOWER = 1.05  # seconds of a rival, relative to those of a fit
Curves = Mapping[str, Mapping[int, Row]]  # rows by method and steps, means over seeds
Case = tuple[str, int, int]  # scene, cameras, samples


def summarize(rows: Sequence[Row]) -> Section:
    """Lay out the gain of each descent at equal seconds, and draw PSNR over seconds."""
    cases: dict[Case, dict[str, dict[int, Row]]] = {}
    for (scene, cameras, spp, method, steps), alike in _by_seed(rows).items():
        curves = cases.setdefault((scene, cameras, spp), {})
        curves.setdefault(method, {})[steps] = alike
    cases = {case: curves for case, curves in cases.items() if {"pyramid", "fit"} <= curves.keys()}
    gains = [decibels for curves in cases.values() for decibels in gain(curves)]
    ends = {"behind": -min(gains), "ahead": max(gains), "mean": fmean(gains)} if gains else {}
    figures = {name: f"{number(value)} dB" for name, value in ends.items()}
    return Section([_gains(cases), _parts(cases)], {"inverse": _chart(cases)}, figures)


def _by_seed(rows: Sequence[Row]) -> dict[tuple, Row]:
    """Return the means of the figures of rows that differ in their seed, and how many seeds."""
    groups = fr.frame_of(rows).groupby(["scene", "cameras", "spp", "method", "steps"], sort=False)
    means = groups.mean(numeric_only=True).assign(seeds=groups.size())
    return {key: row.dropna().to_dict() for key, row in means.iterrows()}


def gain(curves: Curves, figure: str = "psnr_rgb") -> list[float]:
    """Return the decibels of each fit above the best texels within about its seconds.

    The PSNR of a method is its best so far; between two descents it is linear in the logarithm of
    the seconds, beyond them that of the nearest.
    """
    rivals = []
    for method in RIVALS:
        descents = curves.get(method, {}).values()
        points = sorted((math.log(row["seconds"]), row[figure]) for row in descents)
        best_so_far = accumulate((decibels for _, decibels in points), max)
        rivals.append([(time, best) for (time, _), best in zip(points, best_so_far, strict=True)])
    gains = []
    for _, row in sorted(curves["fit"].items()):
        time = math.log(SLOWER * row["seconds"])
        best = max(float(np.interp(time, *np.transpose(rows))) for rows in rivals if rows)
        gains.append(row[figure] - best)
    return gains


def _gains(cases: Mapping[Case, Curves]) -> Table:
    """Lay out the gains of a scene and its cameras: a column per descent."""
    cells: dict[str, dict[tuple[int, int], str]] = {}
    fits = [row for curves in cases.values() for row in curves["fit"].values()]
    most = max((row["seeds"] for row in fits), default=1)
    for case, curves in cases.items():
        seeds = min(row["seeds"] for row in curves["fit"].values())
        line = cells.setdefault(_title(case) + ("" if seeds == most else f" ({seeds:g})"), {})
        for steps, decibels in zip(sorted(curves["fit"]), gain(curves), strict=True):
            line[steps, case[2]] = f"{decibels:+.1f}"
    descents = sorted({d for line in cells.values() for d in line}, key=lambda d: (d[1] != SPP, d))
    lines = [
        (title, *(line.get(descent, "") for descent in descents)) for title, line in cells.items()
    ]
    columns = ("photos", *(f"{steps} steps, {spp} spp" for steps, spp in descents))
    caption = "psnr_rgb of fit in dB over the best of texels and pyramid within equal seconds"
    if most > 1:
        caption += f"; means of {most:g} seeds, or of as many as brackets say"
    return table(caption, columns, lines, name="gains")


def _parts(cases: Mapping[Case, Curves]) -> Table:
    """Lay out what a fit recovers of each map after one number of steps, beside the best texels."""
    lines = []
    for case, curves in cases.items():
        if case[2] != first_spp(SUBJECTS[case[0]]):
            continue
        steps = STEPS_OF_MAPS if STEPS_OF_MAPS in curves["fit"] else max(curves["fit"])
        place, row = sorted(curves["fit"]).index(steps), curves["fit"][steps]
        for name in SUBJECTS[case[0]].keys:
            cells = [
                f"{row[figure]:.1f} ({gain(curves, figure)[place]:+.1f})" if figure in row else ""
                for figure in (name, f"{name}_unseen")
            ]
            lines.append((_title(case), name, *cells, f"{row[f'{name}_constant']:.1f}"))
    columns = ("photos", "map", "seen", "unseen", "constant")
    caption = (
        f"PSNR of maps after {STEPS_OF_MAPS} steps of {SPP} spp (128 of 16 for the painting and "
        "the wall), where photos show them and elsewhere; in brackets over the best texels within "
        "equal seconds; that of the best constant"
    )
    return table(caption, columns, lines, name="maps")


def _title(case: Case) -> str:
    return f"{case[0]}, {case[1]} cameras"


def _chart(cases: Mapping[Case, Curves]) -> Figure:
    """Draw PSNR over seconds, a panel for the fewest and the most cameras of each scene."""
    several = [case for case, curves in cases.items() if len(curves["fit"]) > 1]
    drawn = [case for case in several if case[1] in np.take(SUBJECTS[case[0]].cameras, [0, -1])]
    lines = max(1, math.ceil(len(drawn) / 2))
    figure = fr.new_figure(8, 1 + 2.1 * lines, "Textures recovered from photos")
    axes = np.ravel(figure.subplots(lines, 2, squeeze=False))
    for axis, case in zip(axes, drawn, strict=False):
        for method, color in METHODS.items():
            rows = sorted(cases[case].get(method, {}).values(), key=lambda row: row["seconds"])
            points = np.array([(row["seconds"], row["psnr_rgb"]) for row in rows]).reshape(-1, 2).T
            axis.plot(*points, color=color, marker=MARKERS[method], ms=5, label=method)
        axis.set_title(_title(case), fontsize=9)
        fr.label_axes(axis, "seconds", "PSNR in RGB / dB", legend=False)
    fr.legend_below(figure, axes[0], len(METHODS))
    return figure
