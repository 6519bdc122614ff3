"""The command ``eigengs-dr doctor``: which backends work; it compiles what a first fit needs.

Each backend is tried in its own process, so that a crash ends only this process.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import requires
from importlib.util import find_spec
from typing import TYPE_CHECKING

import click

from ..backend.selection import (
    BACKENDS,
    INSTALL_ADVICE,
    PATH_VARIABLE,
    candidates,
    version_of,
)
from ..backend.types import Record
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
    help="Compile the programs of a first fit.",
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
    facts = report()
    shown = json.dumps(plain(facts), indent=2) if as_json else describe_machine(facts)
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


# --- What the machine has -------------------------------------------------------------------------

PROGRAM = """
import json, sys
from eigengs_dr.backend.selection import describe, select
try:
    types = select(sys.argv[1])
    import drjit as dr
    # A libLLVM may load, and still end the process in dr.clip.
    if dr.clip(types.Float(1, 2, 3), 0, 2)[2] != 2:
        raise RuntimeError("wrong result")
    answer = {"works": True, "problem": None, **describe(sys.argv[1])}
except Exception as error:
    answer = {"works": False, "problem": str(error)}
print(json.dumps(answer))
"""
"""Python program that runs a computation on the backend given by its first argument and prints a
JSON object."""

VARIANTS = "import json, mitsuba; print(json.dumps(mitsuba.variants()))"
"""Python program that prints the variants of Mitsuba as JSON."""


def report() -> Record:
    """Try every backend, and collect the versions of the software on this machine.

    This takes one or two seconds, and starts Dr.Jit in other processes only.

    Returns
    -------
    dict
        ``llvm``, ``cuda``, ``metal`` : dict
            ``works`` and ``problem`` (None, or one line with advice). If the backend
            works, also the entries of `eigengs_dr.backend.selection.describe`.
        ``libllvm`` : list of dict
            ``path``, ``version`` and ``usable`` of every library found.
        ``libllvm_path`` : str or None
            Value of ``DRJIT_LIBLLVM_PATH``.
        ``mitsuba`` : dict
            ``version``, None if Mitsuba is not installed; ``variants``, None if it cannot be
            imported.
        ``python``, ``platform`` : str
    """
    return {
        **{backend: _try(backend) for backend in BACKENDS},
        "libllvm": [{**library._asdict(), "usable": library.usable} for library in candidates()],
        "libllvm_path": os.environ.get(PATH_VARIABLE),
        "mitsuba": _mitsuba(),
        "python": platform.python_version(),
        "platform": platform.platform(),
    }


def describe_machine(diagnosis: Record) -> str:
    """Format a report as text.

    Parameters
    ----------
    diagnosis : dict
        The result of `report`.

    Returns
    -------
    str
        Lines for a terminal, without a newline at the end.
    """
    lines = [f"python   {diagnosis['python']} on {diagnosis['platform']}"]
    for name in BACKENDS:
        trial = diagnosis[name]
        if not trial["works"]:
            lines.append(f"{name:8} does not work: {trial['problem']}")
            continue
        versions, detail = trial["versions"], ""
        if name == "llvm":
            library = f"LLVM {versions['libllvm']} at {versions['libllvm_path']}"
            detail = f", {library}, {trial['threads']} threads on {trial['cpu']}"
        lines.append(f"{name:8} works: Dr.Jit {versions['drjit']}{detail}")
    lines.append("libLLVM  found:" if diagnosis["libllvm"] else "libLLVM  none found")
    used = diagnosis["llvm"]["versions"]["libllvm_path"] if diagnosis["llvm"]["works"] else None
    for library in diagnosis["libllvm"]:
        note = "used" if library["path"] == used else "usable" if library["usable"] else "too old"
        lines.append(f"           {library['version'] or '?':>3}  {library['path']} ({note})")
    lines.append(f"mitsuba  {_mitsuba_line(**diagnosis['mitsuba'])}")
    return "\n".join(lines)


def _mitsuba_line(version: str | None, variants: list[str] | None) -> str:
    """Describe the installation of Mitsuba."""
    if version is None:
        return "not installed; only the plugins need it: pip install 'mitsuba>=3.9,<3.10'"
    if variants:
        return f"{version}: {', '.join(variants)}"
    wanted = [r for r in requires("mitsuba") or [] if r.startswith("drjit")]
    pin = f"; it needs {wanted[0]}, and drjit {version_of('drjit')} is installed" if wanted else ""
    return f"{version}: cannot be imported{pin}: pip install 'mitsuba>=3.9,<3.10'"


def _try(name: str) -> Record:
    """Run `PROGRAM` with a backend, in another process."""
    process = _python(PROGRAM, name)
    if process.returncode == 0:
        return dict(json.loads(process.stdout.splitlines()[-1]))
    code = process.returncode
    status = f"signal {-code}" if code < 0 else f"exit code {code}"
    return {"works": False, "problem": f"the process ended with {status}; {INSTALL_ADVICE}"}


def _mitsuba() -> Record:
    """Return the version and the variants of Mitsuba."""
    if find_spec("mitsuba") is None:
        return {"version": None, "variants": None}
    process = _python(VARIANTS)
    variants = json.loads(process.stdout) if process.returncode == 0 else None
    return {"version": version_of("mitsuba"), "variants": variants}


def _python(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python code in a fresh interpreter."""
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)
