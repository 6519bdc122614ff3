"""The command ``eigengs-dr doctor``: which backends work; it compiles what a first fit needs."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import TYPE_CHECKING

import click

from ..backend import doctor as machine
from ..backend.selection import BACKENDS
from . import options
from .console import MISSED, bar
from .outputs import plain

if TYPE_CHECKING:
    import eigengs_dr as eg


@click.command()
@options.as_json
@click.option(
    "--compile/--no-compile",
    "compiles",
    default=True,
    help="Compile the programs of a first fit.  [default: compile]",
)
@options.shared("quiet")
def doctor(run: options.Run, as_json: bool, compiles: bool) -> None:
    """Show which backends work on this machine and what to install.

    The first time, it also compiles the programs that a first fit needs, and with Mitsuba those of
    a texture in a scene. Dr.Jit keeps them on disk, so that the first results come as fast as later
    ones. The exit code is 1 if no backend works.

    \b
    Examples:
      eigengs-dr doctor
      eigengs-dr doctor --json --no-compile
    """
    facts = machine.report()
    shown = json.dumps(plain(facts), indent=2) if as_json else machine.describe_machine(facts)
    click.echo(shown)
    works = any(facts[name]["works"] for name in BACKENDS)
    if compiles and works:
        with bar(run.quiet) as show:
            note = compile_programs(show)
        if not as_json:
            run.tell(note)
    run.context.exit(0 if works else MISSED)


def compile_programs(show: Callable[..., None]) -> str:
    """Fit and draw a small photo, and light it where Mitsuba is installed; say how long it took.

    The programs are those of every size. Of the 107 kernels of a first fit of 5,000 Gaussians, 3
    remain to be compiled.
    """
    started = time.perf_counter()
    import eigengs_dr as eg

    image = eg.sample("coffee")[:400:4, :592:4]
    steps = partial(show, "compile")
    fit = eg.fit(image, 300, iterations=150, progress=lambda done, total, row: steps(done, 180))
    eg.picture_of(fit.gaussians)
    if find_spec("mitsuba"):
        steps(150, 180)
        _render(fit.gaussians)
    steps(180, 180)
    return f"programs of a first fit are compiled ({time.perf_counter() - started:.1f} s)"


def _render(gaussians: eg.Gaussians) -> None:
    """Render a wall with a texture, on the backend of its Gaussians."""
    import drjit as dr
    import mitsuba as mi

    from ..backend.arrays import types_of
    from ..plugins import register_plugins, texture_of

    mi.set_variant(f"{types_of(gaussians.mean).backend}_ad_rgb")
    register_plugins()
    look = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    wall = {"type": "diffuse", "reflectance": texture_of(gaussians)}
    scene = {
        "type": "scene",
        "integrator": {"type": "path"},
        "sensor": {"type": "perspective", "fov": 40, "to_world": look, "film": film},
        "sky": {"type": "constant"},
        "wall": {"type": "rectangle", "bsdf": wall},
    }
    dr.eval(mi.render(mi.load_dict(scene), spp=4))
