"""The speed and memory of a texture of Gaussians in Mitsuba, against a bitmap."""

import math
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import drjit as dr
import numpy as np

import eigengs_dr as eg
from eigengs_bench import alike
from eigengs_bench.clock import interleaved_apart
from eigengs_bench.names import TEXTURE_PARTS
from eigengs_bench.report import Section, Table, table
from eigengs_bench.rows import Job, Row, Task
from eigengs_dr.cli.scene import load_mitsuba
from eigengs_dr.image.color import to_linear
from eigengs_dr.image.resize import resample
from eigengs_dr.storage.npz import sizes_of

SIDE, TEXELS, SPP = 512, 1024, 16  # of the picture, of the bitmap, and samples per pixel
COUNTS = (500, 5_000, 20_000)  # Gaussians of the textures
SETTLED = 5_000  # Gaussians of the texture that is also prefiltered and differentiated
CHANGED = (5_000, 50_000)  # Gaussians of the textures whose parameters change
STEPS, WARM_UP, ROUNDS = 100, 2, 9  # of the fits; rounds that compile, and that are measured
HELD = (1_000, 10_000, 100_000)  # Gaussians of the files that are loaded
PIXELS = 32  # of the picture of a file, for each of its Gaussians


def run(task: Task, parts: Sequence[str] = TEXTURE_PARTS) -> list[Row]:
    """Time a material ball with each texture in turn; every figure is a median.

    `ratio_N` is rendering with N Gaussians over rendering with a bitmap, `ratio_filtered_N` with
    the prefilter, `ratio_step` picture and gradient of all
    parameters by `prb`, `ratio_step_filtered` these with the prefilter, and `ratio_step_drawn`
    these with `texels`. Each scene has a process of its own, as
    beside others Mitsuba takes longer.
    `bytes_N` is what a texture holds in memory, `held_N` that over the arrays of its file.
    For the other rows see `eigengs_bench.alike`.
    """
    variant = f"{task.backend}_ad_rgb"
    ball: Row = {"variant": variant, "at": time.time()}  # each call measures anew
    jobs: dict[str, Iterable[Job]] = {
        "posters": alike.jobs_of_posters(variant, task.data),
        "lights": alike.jobs_of_lights(variant),
        "ball": [(ball, partial(measure, variant, task.progress))],
    }
    return [row for part in parts for row in task.measure("texture", jobs[part], part)]


def summarize(rows: Sequence[Row]) -> Section:
    """Lay out the figures of the last row of a ball, and the costs for a user of the texture."""
    posters = [row for row in rows if "poster" in row["job"]]
    lights = [row for row in rows if "light" in row["job"]]
    balls = [row for row in rows if not {"poster", "light"} & row["job"].keys()]
    tables = [
        *([_ball(balls)] if balls else []),
        *([_posters(posters)] if posters else []),
        *([_losses(balls, posters)] if balls and posters else []),
        *([_lights(lights)] if lights else []),
    ]
    return Section(tables, figures=_figures(balls, posters, lights))


def _ball(balls: Sequence[Row]) -> Table:
    """List the figures of the last row."""
    lines = [(k, f"{v:.4g}") for k, v in balls[-1].items() if isinstance(v, float)]
    return table("Texture", ("figure", "value"), lines)._replace(rows=balls)


HELD_BY_POSTERS = ("bitmap_bytes", "bytes", "filtered_bytes", "small_bytes")


def _posters(posters: Sequence[Row]) -> Table:
    """Lay out the bitmaps and the Gaussians whose pictures of posters are equally good."""
    caption = (
        "kB of the smallest bitmap of 8 bits, and of the fewest Gaussians, with which a poster "
        f"of {alike.TEXELS:,} x {alike.TEXELS:,} texels, seen aslant on a film of "
        f"{alike.PIXELS} x {alike.PIXELS} pixels, keeps 40 dB; the text 30 dB"
    )
    columns = ["poster", "side, texels", "Gaussians", "bitmap", "points", "prefilter", "small"]
    columns += ["points over bitmap", "small over bitmap"]
    lines = [
        (
            row["job"]["poster"],
            f"{row['side']}",
            f"{row['gaussians']:,}",
            *(f"{row[k] / 1e3:,.0f}" for k in HELD_BY_POSTERS),
            f"{row['ratio']:.2f}",
            f"{row['ratio_small']:.2f}",
        )
        for row in posters
    ]
    return table(caption, columns, lines, name="posters")._replace(rows=posters)


def _lights(lights: Sequence[Row]) -> Table:
    """Lay out what lights of Gaussians differ by from their bitmaps, and what they cost."""
    caption = (
        f"A fit of logarithms for {alike.GOAL:g} dB beside the envmap of a bitmap of "
        f"{2 * alike.ROWS} x {alike.ROWS} texels: PSNR of lookups in even directions, and of "
        "pictures without noise; largest difference of the mean of a channel; variance at equal "
        "samples and time of a picture, over those with the envmap; memory"
    )
    columns = ["light", "Gaussians", "lookups", "pictures", "mean", "variance", "time"]
    columns += ["Gaussians hold", "envmap holds"]
    lines = [
        (
            row["job"]["light"],
            f"{row['gaussians']:,}",
            *(f"{row[k]:.1f} dB" for k in ("lookups", "images")),
            f"{row['mean']:.2%}",
            *(f"{row[k]:.2f}" for k in ("variance", "ratio")),
            *(f"{row[k] / 1e6:.3g} MB" for k in ("bytes", "bitmap_bytes")),
        )
        for row in lights
    ]
    return table(caption, columns, lines, name="lights")._replace(rows=lights)


def _figures(balls: Sequence[Row], posters: Sequence[Row], lights: Sequence[Row]) -> dict[str, str]:
    """Return figures for sentences: of the last ball, memory of photos, and time of lights."""
    small = [row["ratio_small"] for row in posters if row["kind"] != "text"]
    ratios = [row["ratio"] for row in lights]
    figures = {"small": f"{min(small):.2f} to {max(small):.2f}"} if small else {}
    figures |= {"lights": f"{min(ratios):.2f} to {max(ratios):.2f}"} if ratios else {}
    for row in balls[-1:]:
        held = [row[f"held_{count}"] for count in HELD]
        figures["held"] = f"{min(held):.1f} to {max(held):.1f}"
        figures |= {name: f"{row[f'ratio_{name}']:.2f}" for name in ("step", "step_filtered")}
        figures["prefiltered"] = f"{row[f'ratio_filtered_{SETTLED}']:.2f}"
    return figures


def _losses(balls: Sequence[Row], posters: Sequence[Row]) -> Table:
    """Lay out what Gaussians cost beside a bitmap."""
    row, kinds = balls[-1], ("photo", "material", "text")
    ratio = {k: [r["ratio"] for r in posters if r["kind"] == k] for k in kinds}
    small = [r["ratio_small"] for r in posters if r["kind"] != "text"]
    memory = [
        ("memory, photos", ratio["photo"]),
        ("memory, materials", ratio["material"]),
        ("memory, sharp text", ratio["text"]),
        ('memory, `memory="small"`, no text', small),
    ]
    lines = [(what, f"{median(n):.2f}", f"{min(n):.2f} to {max(n):.2f}") for what, n in memory if n]
    lines += [
        (what, f"{row[name]:.2f}", "")
        for what, name in (
            ("time of a picture", f"ratio_{SETTLED}"),
            ("time of a picture, prefilter", f"ratio_filtered_{SETTLED}"),
            (f"the same, {CHANGED[-1]:,} Gaussians", f"ratio_filtered_{CHANGED[-1]}"),
            ("time of a step of `prb`", "ratio_step"),
            ("time of a step of `prb`, prefilter", "ratio_step_filtered"),
            ("the same, drawn into a bitmap", "ratio_step_drawn"),
        )
    ]
    caption = (
        "Gaussians over bitmaps; memory for equally good pictures of posters, time with "
        f"{SETTLED:,} Gaussians"
    )
    columns = ("figure", "Gaussians over a bitmap", "from poster to poster")
    return table(caption, columns, lines, name="losses")._replace(rows=[*balls, *posters])


def measure(variant: str, progress: Callable[..., None] = lambda *_: None) -> Row:
    """Measure the figures of `run`."""
    mi = load_mitsuba(variant, quiet=False)
    from eigengs_dr.plugins import pixel_angle

    picture, sets = eg.sample("coffee")[:400, 100:500], {}
    counts = sorted({*COUNTS, *CHANGED})
    for count in counts:
        sets[count] = eg.fit(picture, count, STEPS).gaussians
        progress("fits", len(sets), len(counts))
    angle = pixel_angle(mi.load_dict(alike.camera(mi, SIDE, SPP)))
    with TemporaryDirectory() as folder:
        files = {count: Path(folder) / f"{count}.npz" for count in counts}
        for count, path in files.items():
            sets[count].save(path)
        shown = partial(_picture, variant, SIDE, SPP)
        makers = {"bitmap": partial(shown, files[SETTLED], TEXELS)}
        makers |= {f"gaussians_{n}": partial(shown, files[n]) for n in counts}
        makers |= {f"filtered_{n}": partial(shown, files[n], prefilter=angle) for n in CHANGED}
        ends = {"bitmap": "bitmap", "gaussians": f"gaussians_{SETTLED}"}
        ends["filtered"] = f"filtered_{SETTLED}"
        makers |= {f"step_{n}": partial(makers[end], by_step=True) for n, end in ends.items()}
        makers["step_drawn"] = partial(shown, files[SETTLED], drawn=TEXELS, by_step=True)
        timed = interleaved_apart(makers, WARM_UP, ROUNDS, partial(progress, "pictures"))
    return {
        **hold(mi, progress),
        **{f"{name}_ms": ms for name, ms in timed.items()},
        **{f"ratio_{n}": timed[f"gaussians_{n}"] / timed["bitmap"] for n in counts},
        **{f"ratio_filtered_{n}": timed[f"filtered_{n}"] / timed["bitmap"] for n in CHANGED},
        "ratio_step": timed["step_gaussians"] / timed["step_bitmap"],
        "ratio_step_filtered": timed["step_filtered"] / timed["step_bitmap"],
        "ratio_step_drawn": timed["step_drawn"] / timed["step_bitmap"],
    }


def _picture(
    variant: str,
    side: int,
    samples: int,
    path: Path,
    texels: int = 0,
    prefilter: float = 0.0,
    drawn: int = 0,
    by_step: bool = False,
) -> Callable[[], Any]:
    """Return what renders the ball with a set, or with a bitmap of it; or what differentiates it.

    It runs in a process of its own, see `interleaved_apart`.
    """
    mi = load_mitsuba(variant, quiet=False)
    texture: Row = {"type": "gaussian_texture", "filename": str(path), "texels": drawn}
    texture["prefilter"] = prefilter
    if texels:
        coded = np.clip(eg.picture_of(eg.Gaussians.load(path), texels, texels), 0, 1)
        data = mi.TensorXf(to_linear(coded).astype(np.float32))
        texture = {"type": "bitmap", "data": data, "raw": True}
    scene = _shown(mi, texture, side, samples)
    return _step(mi, scene) if by_step else partial(mi.render, scene)


def _shown(mi: Any, texture: dict[str, Any], side: int, samples: int) -> Any:
    """Load the ball with a texture, under a lamp and the sky."""
    light = {"type": "area", "radiance": {"type": "rgb", "value": 20.0}}
    emitters = {
        "lamp": {"type": "sphere", "center": [3, 4, 3], "emitter": light},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.4}},
    }
    return mi.load_dict(alike.ball(mi, texture, alike.camera(mi, side, samples), emitters))


def _step(mi: Any, scene: Any) -> Callable[[], Any]:
    integrator = mi.load_dict({"type": "prb", "max_depth": 5})
    parameters = mi.traverse(scene)
    parameters.keep(r".*base_color\.(data|mean|factor|color|background)")

    def step() -> Any:
        for name, value in parameters:
            dr.enable_grad(value)
            parameters[name] = value
        parameters.update()
        dr.backward(dr.mean(mi.render(scene, parameters, integrator=integrator), axis=None))
        return [dr.grad(value) for _, value in parameters]

    return step


def hold(mi: Any, progress: Callable[..., None] = lambda *_: None) -> Row:
    """Measure the memory of textures from files."""
    from eigengs_dr.plugins import resident_bytes

    row: Row = {}
    for done, count in enumerate(HELD):
        side = round(math.sqrt(PIXELS * count))
        picture = resample(eg.sample("coffee")[:400, 100:500], side, side)
        with TemporaryDirectory() as folder:
            path = Path(folder) / "set.npz"
            eg.fit(picture, count, 0).gaussians.save(path)
            file = {"type": "gaussian_texture", "filename": str(path)}
            row[f"bytes_{count}"] = resident_bytes(mi.load_dict(file))
            row[f"held_{count}"] = row[f"bytes_{count}"] / sum(sizes_of(path).values())
        progress("files", done + 1, len(HELD))
    return row
