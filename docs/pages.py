"""The pages of `eigengs_dr.view` that the manual embeds: made when it is built."""

from pathlib import Path

import eigengs_dr as eg
from eigengs_dr.eigenbasis.eigengs import EigenGS

FOLDER = Path(__file__).parent.parent / "build" / "docs" / "extra"
"""Sphinx copies what is in it beside the manual."""


def write_pages() -> None:
    """Write pages/photo.html, pages/levels.html and pages/model.html."""
    folder = FOLDER / "pages"
    folder.mkdir(parents=True, exist_ok=True)
    coffee, cat = eg.sample("coffee"), eg.sample("chelsea")
    many = eg.fit(coffee, 20_000)
    eg.view(many, coffee, title="A photo").save(folder / "photo.html")
    counts = eg.level_counts(5000, 4)
    nested = eg.fit(cat, 5000, levels=4)
    eg.view(nested, cat, levels=counts, title="Levels of detail").save(folder / "levels.html")
    model = EigenGS.load("natural")
    eg.view(model, coffee, title="An eigenbasis").save(folder / "model.html")
