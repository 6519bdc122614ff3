"""Pages of `eigengs_dr.view` in the manual, and the parameters of the texture in its page.

``python docs/pages.py`` writes the table of the parameters between its marks.
"""

import inspect
import re
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import eigengs_dr as eg
from eigengs_bench.pages import filled
from eigengs_dr.eigenbasis.eigengs import SHIPPED, EigenGS
from eigengs_dr.image.space import DATA
from eigengs_dr.relight.lights import LightTable

FOLDER = Path(__file__).parent.parent / "build" / "docs" / "extra"
"""Sphinx copies what is in it beside the manual."""

REFERENCES = {
    f"gaussian_{name}": Path(__file__).parent / "reference" / f"gaussian-{name}.md"
    for name in ("texture", "environment")
}
"""The page of each plugin."""


def write_pages() -> None:
    """Write pages/photo.html, pages/levels.html and pages/model.html."""
    folder = FOLDER / "pages"
    folder.mkdir(parents=True, exist_ok=True)
    coffee, cat = eg.sample("coffee"), eg.sample("chelsea")
    many = eg.fit(coffee, 20_000)
    eg.view(many, coffee, title="A photo").save(folder / "photo.html")
    counts = eg.level_counts(5000, 4)
    nested = eg.fit(cat, counts)
    eg.view(nested, cat, levels=counts, title="Levels of detail").save(folder / "levels.html")
    model = EigenGS.load("natural")
    eg.view(model, coffee, title="An eigenbasis").save(folder / "model.html")


ENTRY = re.compile(r"^(\w[\w, ]*) : (.+)\n((?: {4}.*\n?)+)", re.M)
"""A parameter in a docstring: its name, or several, its type with the default, and what it is."""


def outdated() -> dict[Path, str]:
    """Return the pages of plugins with what they should hold, where a table is another one."""
    pages = {}
    for plugin, page in REFERENCES.items():
        there = page.read_text("utf-8")
        right = filled(there, {f"parameters: {plugin}": plugin_parameters(plugin)}, page.name)
        pages |= {} if right == there else {page: right}
    return pages


def plugin_parameters(plugin: str) -> str:
    """Return the table of the parameters of a plugin, from the docstring of its class.

    Flags are those of `mitsuba.traverse`: what it shows can be changed, and perhaps differentiated.
    """
    import mitsuba as mi

    from eigengs_dr.plugins.parameters import plugin_of
    from eigengs_dr.plugins.registration import PLUGINS

    mi.set_variant("llvm_ad_rgb")
    eg.register_plugins()
    gaussians = eg.Gaussians.from_arrays([[4, 4]], [[1, 0, 1]], [[1]], size=(8, 8), space="linear")
    model = {"type": plugin, "model": str(SHIPPED["natural"])}
    flags = _flags(mi, plugin_of(plugin, gaussians)) | _flags(mi, model)
    if plugin == "gaussian_texture":
        with TemporaryDirectory() as folder:
            lit = {"type": plugin, "model": f"{folder}/model.npz"}
            table = LightTable(np.eye(3), np.ones((3, 3, 2)), "hsh", 0.1)
            eg.Relightable(replace(gaussians, space=DATA), table).save(lit["model"])
            flags |= _flags(mi, lit)
    lines = ["| parameter | type | description | default | flags |", "|---|---|---|---|---|"]
    for names, kind, text in ENTRY.findall(str(inspect.getdoc(PLUGINS[plugin][1]())) + "\n"):
        kind, _, default = kind.partition(", default: ")
        shown = ", ".join(f"`{name}`" for name in names.split(", "))
        said = " ".join(text.split()).replace("``", "`").removesuffix(".")
        lines.append(f"| {shown} | {kind} | {said} | {default or '-'} | {flags.get(names, '')} |")
    return "\n".join(lines)


def _flags(mi: Any, plugin: dict[str, Any]) -> dict[str, str]:
    """Return the flags of a plugin's parameters: E for a change, D for derivatives."""
    parameters = mi.traverse(mi.load_dict(plugin))
    fixed = mi.ParamFlags.NonDifferentiable
    return {key: "E" if parameters.flags(key) & fixed else "D, E" for key, _ in parameters}


if __name__ == "__main__":
    for page, text in outdated().items():
        page.write_text(text, "utf-8")
