"""Pages of `eigengs_dr.view` in the manual, and the parts of the reference that the code writes.

``python tools/manual/pages.py`` writes these between their marks: public names, the help of
commands, and the parameters of plugins.
"""

import ast
import inspect
import pydoc
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FunctionType
from typing import Any

import click
import numpy as np

import eigengs_dr as eg
from eigengs_bench.pages import MARK, filled
from eigengs_dr.cli.main import main
from eigengs_dr.eigenbasis.eigengs import SHIPPED, EigenGS
from eigengs_dr.image.space import DATA
from eigengs_dr.relight.lights import LightTable

FOLDER = Path(__file__).parents[2] / "build" / "docs" / "extra"
"""Sphinx copies what is in it beside the manual."""

REFERENCE = Path(__file__).parents[2] / "docs" / "reference"

TEXTURE_PAGE = "gaussian-texture.md"


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


LISTED = re.compile(r"^- `([\w.]+)", re.M)
"""A name in a list of the reference; a line of a new one may end here."""

HELP = re.compile(r"(\n\nOptions:(?=\n *--help))?\n *--help +Show this message and exit\.")
"""What the help of every command says of itself."""

LONG = 20
"""Length of a default value from which a signature shows dots instead."""


def outdated() -> dict[Path, str]:
    """Return the pages of the reference that differ from the code, with what they should hold."""
    found = {}
    for page in (REFERENCE / "python.md", REFERENCE / "commands.md", *plugin_pages().values()):
        there = page.read_text("utf-8")
        parts = {
            mark: names_list(LISTED.findall(lines))
            for mark, kind, lines in MARK.findall(there)
            if kind == "names"
        }
        if "<!-- commands: all -->" in there:
            parts["commands: all"] = helps()
        plugins = [plugin for plugin, its_page in plugin_pages().items() if page == its_page]
        parts |= {f"parameters: {plugin}": plugin_parameters(plugin) for plugin in plugins}
        right = filled(there, parts, page.name)
        found |= {} if right == there else {page: right}
    return found


def plugin_pages() -> dict[str, Path]:
    """Return the page of each plugin."""
    plugins = ("gaussian_texture", "gaussian_environment")
    return {name: REFERENCE / f"{name.replace('_', '-')}.md" for name in plugins}


def names_list(names: list[str]) -> str:
    """Return the list of public names: signature, first line of the docstring, methods."""
    lines = []
    for name in names:
        found = pydoc.locate(f"eigengs_dr.{name}")
        text = inspect.getdoc(found) if callable(found) else documented(name)
        first = str(text).splitlines()[0].replace("``", "`").removesuffix(".")
        methods = ", ".join(f"`{method}`" for method in methods_of(found))
        shown = f"{first}. Methods: {methods}" if methods else first
        lines.append(f"- `{name}{signature_of(found)}`: {shown}")
    return "\n".join(lines)


def documented(name: str) -> str:
    """Return the first sentence below the definition of a constant."""
    package = Path(eg.__file__).parent
    stub = (package / "__init__.pyi").read_text("utf-8")
    (module,) = re.findall(rf"^from \.([\w.]+) import {name} as", stub, re.M)
    source = package / f"{module.replace('.', '/')}.py"
    for node, text in pairwise(ast.parse(source.read_text("utf-8")).body):
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == name:
            assert isinstance(text, ast.Expr), f"{name} has no text below its definition"
            return " ".join(ast.literal_eval(text.value).split()).split(". ")[0]
    raise ValueError(f"{source}: does not define {name}")


def signature_of(found: object) -> str:
    """Return the parameters of a function or a class, without types and long defaults."""
    if not callable(found) or (isinstance(found, type) and issubclass(found, BaseException)):
        return ""
    shown = []
    for parameter in inspect.signature(found).parameters.values():
        default = repr(parameter.default)
        if parameter.default is not parameter.empty and len(default) >= LONG:
            parameter = parameter.replace(default=Dots())
        shown.append(parameter.replace(annotation=parameter.empty))
    return str(inspect.Signature(shown))


class Dots:
    """Stands for a long default value."""

    def __repr__(self) -> str:
        """Return three dots."""
        return "..."


def methods_of(found: object) -> list[str]:
    """List the public methods and properties that a class of this package defines."""
    kinds = (property, classmethod, staticmethod, FunctionType)
    own = vars(found) if isinstance(found, type) else {}
    return [name for name, made in own.items() if name[0] != "_" and type(made) in kinds]


def helps() -> str:
    """Return what ``--help`` of the program and of each of its commands prints.

    Only that of the program lists the option itself. Groups of commands are of other packages.
    """
    top = click.Context(main, info_name="eigengs-dr", show_default=True, terminal_width=80)
    texts = {"eigengs-dr": main.get_help(top)}
    commands = {k: v for k, v in main.commands.items() if not isinstance(v, click.Group)}
    for name, command in commands.items():
        context = click.Context(command, top, name)  # as wide as that above
        texts[f"eigengs-dr {name}"] = HELP.sub("", command.get_help(context))
    parts = [f"## {name}\n\n```text\n{text}\n```" for name, text in texts.items()]
    return "\n\n".join(parts)


def plugin_parameters(plugin: str) -> str:
    """Return the table of the parameters of a plugin, from the docstring of its class.

    Flags are those of `mitsuba.traverse`: what it shows can be changed, and perhaps differentiated.
    One row stands for all parameters that the texture describes in the same words.
    """
    flags = _flags_of(plugin)
    texture = [] if plugin == "gaussian_texture" else _entries("gaussian_texture")
    lines = ["| parameter | type | description | default | flags |", "|---|---|---|---|---|"]
    same = []
    for names, kind, text in _entries(plugin):
        shown = ", ".join(f"`{name}`" for name in names.split(", "))
        if (names, kind, text) in texture:
            same.append(shown)
            continue
        kind, _, default = kind.partition(", default: ")
        said = " ".join(text.split()).replace("``", "`").removesuffix(".")
        lines.append(f"| {shown} | {kind} | {said} | {default} | {flags.get(names, '')} |")
    if same:
        row = f"| {', '.join(same)} | | [as of a texture]({TEXTURE_PAGE}#parameters) | | |"
        lines.insert(2, row)
    return "\n".join(lines)


def _entries(plugin: str) -> list[tuple[str, str, str]]:
    """Return the parameters in the docstring of a plugin: names, type with default, description."""
    from eigengs_dr.plugins.registration import PLUGINS

    return ENTRY.findall(str(inspect.getdoc(PLUGINS[plugin][1]())) + "\n")


def _flags_of(plugin: str) -> dict[str, str]:
    """Return the flags of all parameters of a plugin, whatever its source."""
    import mitsuba as mi

    from eigengs_dr.plugins.parameters import plugin_of

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
    return flags


def _flags(mi: Any, plugin: dict[str, Any]) -> dict[str, str]:
    """Return the flags of a plugin's parameters: E for a change, D for derivatives."""
    parameters = mi.traverse(mi.load_dict(plugin))
    fixed = mi.ParamFlags.NonDifferentiable
    return {key: "E" if parameters.flags(key) & fixed else "D, E" for key, _ in parameters}


if __name__ == "__main__":
    for page, text in outdated().items():
        page.write_text(text, "utf-8")
