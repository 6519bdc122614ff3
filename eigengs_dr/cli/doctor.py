"""The command ``eigengs-dr doctor``: which backends work, and whether the GPU is correct."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import click
import numpy as np
from numpy.typing import ArrayLike

from ..backend import doctor as machine
from ..backend.doctor import ALLOWED, Agreement, compare_backends
from ..backend.selection import BACKENDS
from ..backend.types import Floats, Record
from . import options

if TYPE_CHECKING:
    import eigengs_dr as eg
from .console import MISSED, print_message, table
from .outputs import plain


@click.command()
@options.as_json
@click.option("--gpu", is_flag=True, help="Compare the GPU with llvm; takes a few minutes.")
@click.option("--trial", type=click.Choice(list(ALLOWED)), hidden=True)
@options.choice("--backend", BACKENDS, "Backend of the GPU.  [default: cuda]", True)
@click.pass_context
def doctor(
    context: click.Context, as_json: bool, gpu: bool, trial: str | None, backend: str | None
) -> None:
    """Show which backends work on this machine and what to install.

    With --gpu, a small fit and a scene run on the GPU and on llvm, and a table, for reports, shows
    their times and differences. The exit code is 1 if no backend works, or if the results of the
    GPU differ.

    \b
    Examples:
      eigengs-dr doctor
      eigengs-dr doctor --gpu
    """
    if trial:
        click.echo(json.dumps(_run_trial(trial, backend or "llvm")))
        return
    if backend and not gpu:
        raise click.UsageError("--backend needs --gpu")
    facts = machine.report()
    works = any(facts[name]["works"] for name in BACKENDS)
    device = backend or "cuda"
    comparisons: list[Agreement] = []
    if gpu and not facts[device]["works"]:
        raise click.ClickException(f"--gpu: {device} does not work: {facts[device]['problem']}")
    for name in ALLOWED if gpu else ():
        print_message(f"{name}: on llvm and on {device}")
        comparisons.append(compare_backends(name, device))
    if as_json:
        facts |= {"trials": list(map(_record, comparisons))} if gpu else {}
        click.echo(json.dumps(plain(facts), indent=2))
    else:
        click.echo(machine.describe_machine(facts))
    if gpu and not as_json:
        click.echo("\n".join(["", *_describe(comparisons, device)]))
    context.exit(0 if works and all(row.agrees for row in comparisons) else MISSED)


def _record(row: Agreement) -> Record:
    """Return a trial with the names of its figures, for JSON."""
    sides = {"llvm": row.llvm._asdict(), "gpu": row.gpu._asdict()}
    return row._asdict() | sides | {"agrees": row.agrees}


def _describe(comparisons: list[Agreement], device: str) -> list[str]:
    """Format the trials as lines: times, differences and failures."""
    rows = [["trial", "llvm, s", f"{device}, s", "difference", "allowed", ""]]
    problems = []
    for row in comparisons:
        times = [f"{t.seconds:.3f}" if not t.problem else "failed" for t in (row.llvm, row.gpu)]
        verdict = "agrees" if row.agrees else "DIFFERS"
        rows.append([row.name, *times, f"{row.difference:.1e}", f"{ALLOWED[row.name]:g}", verdict])
        for place, trial in (("llvm", row.llvm), (device, row.gpu)):
            if trial.problem:
                problems.append(f"{row.name} on {place}: {trial.problem}")
    return table(rows) + problems


# ---------------------------------------------------------------------------------------------
#  Trials: each returns figures that a GPU must reproduce
# ---------------------------------------------------------------------------------------------


def _run_trial(name: str, backend: str) -> Record:
    """Run a trial twice, the second time with compiled programs; return time and figures."""
    trials: dict[str, Callable[[str], ArrayLike]] = {"fit": _fit, "scene": _scene}
    trials[name](backend)
    started = time.perf_counter()
    figures = np.asarray(trials[name](backend), float)
    return {"seconds": time.perf_counter() - started, "figures": figures.ravel().tolist()}


def _picture() -> Floats:
    """Return an image of waves and an edge, shape (48, 64, 3), in [0, 1]."""
    y, x = np.mgrid[0:48, 0:64] / 64
    waves = [0.5 + 0.4 * np.sin(a * x + b * y) for a, b in ((9, 4), (5, -13), (17, 3))]
    return np.stack(waves, axis=-1) * np.where(x + y > 0.9, 0.6, 1.0)[..., None]


def _fit(backend: str) -> list[float]:
    """Return the PSNRs of a fit."""
    import eigengs_dr as eg

    result = eg.fit(_picture(), 200, iterations=30, backend=backend, progress=False)
    return [row["psnr_rgb"] for row in result.trace] + [result.psnr_ycbcr]


def _scene(backend: str) -> Floats:
    """Return the pixels of a textured rectangle under constant light."""
    from ..plugins import register_plugins, texture_of  # first: its error names what to install

    # isort: split
    import mitsuba as mi

    mi.set_variant(f"{backend}_ad_rgb")
    register_plugins()
    look = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    wall = {"type": "diffuse", "reflectance": texture_of(_set(backend))}
    scene = {
        "type": "scene",
        "integrator": {"type": "direct"},
        "sensor": {"type": "perspective", "fov": 40, "to_world": look, "film": film},
        "sky": {"type": "constant"},
        "wall": {"type": "rectangle", "bsdf": wall},
    }
    return np.ravel(mi.render(mi.load_dict(scene), spp=256, seed=0).numpy())


def _set(backend: str) -> eg.Gaussians:
    """Return a random set, not a fitted one, so that it is the same on every backend."""
    import eigengs_dr as eg

    random = np.random.default_rng(0)
    factor = np.stack([*random.uniform(0.2, 0.5, (2, 60)), np.full(60, 0.3)], axis=1)
    factor[:, 1] -= 0.35
    return eg.Gaussians.from_arrays(
        random.uniform([0, 0], [32, 24], (60, 2)),
        factor,
        random.uniform(-0.2, 0.3, (60, 3)),
        background=np.full(3, 0.4),
        size=(32, 24),
        space="linear",
        backend=backend,
    )
