"""Pages of `eigengs_dr.view` in the manual, and the parameters of the texture in its page.

``python docs/pages.py`` writes the table of the parameters between its marks.
"""

import inspect
import re
from pathlib import Path
from typing import Any

import eigengs_dr as eg
from eigengs_bench.pages import filled
from eigengs_dr.eigenbasis.eigengs import SHIPPED, EigenGS

FOLDER = Path(__file__).parent.parent / "build" / "docs" / "extra"
"""Sphinx copies what is in it beside the manual."""

PLUGIN = Path(__file__).parent / "reference" / "gaussian-texture.md"
"""The page with the parameters of the texture."""


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
    """Return the page of the texture with what it should hold, if its table is another one."""
    there = PLUGIN.read_text("utf-8")
    right = filled(there, {"parameters: gaussian_texture": plugin_parameters()}, PLUGIN.name)
    return {} if right == there else {PLUGIN: right}


def plugin_parameters() -> str:
    """Return the table of the parameters of ``gaussian_texture``, from the docstring of its class.

    Flags are those of `mitsuba.traverse`: what it shows can be changed, and perhaps differentiated.
    """
    import mitsuba as mi

    from eigengs_dr.plugins.gaussian_texture import gaussian_texture
    from eigengs_dr.plugins.parameters import texture_of

    mi.set_variant("llvm_ad_rgb")
    eg.register_plugins()
    gaussians = eg.Gaussians.from_arrays([[4, 4]], [[1, 0, 1]], [[1]], size=(8, 8), space="data")
    model = {"type": "gaussian_texture", "model": str(SHIPPED["natural"])}
    flags = _flags(mi, texture_of(gaussians)) | _flags(mi, model)
    lines = ["| parameter | type | description | default | flags |", "|---|---|---|---|---|"]
    for names, kind, text in ENTRY.findall(str(inspect.getdoc(gaussian_texture())) + "\n"):
        kind, _, default = kind.partition(", default: ")
        shown = ", ".join(f"`{name}`" for name in names.split(", "))
        said = " ".join(text.split()).replace("``", "`").removesuffix(".")
        lines.append(f"| {shown} | {kind} | {said} | {default or '-'} | {flags.get(names, '')} |")
    return "\n".join(lines)


def _flags(mi: Any, texture: dict[str, Any]) -> dict[str, str]:
    """Return the flags of a texture's parameters: E for a change, D for derivatives."""
    parameters = mi.traverse(mi.load_dict(texture))
    fixed = mi.ParamFlags.NonDifferentiable
    return {key: "E" if parameters.flags(key) & fixed else "D, E" for key, _ in parameters}


if __name__ == "__main__":
    for page, text in outdated().items():
        page.write_text(text, "utf-8")
