"""What sphinx-gallery calls: the order of the tutorials, and the pictures that they wrote."""

from pathlib import Path
from typing import Any

from PIL import Image
from sphinx_gallery.scrapers import figure_rst

ORDER = (
    "fit_an_image.py",
    "film.py",
    "texture.py",
    "photos_of_a_ball.py",
    "numpy_and_torch.py",
    "render_and_differentiate.py",
    "fit_for_scene.py",
    "convert_scene.py",
)
"""Scripts in the order of the manual; others follow."""

SMALLEST = 256
"""Pictures narrower than this are shown at a multiple of their size."""

BUILD = Path(__file__).parent.parent / "build" / "docs" / "examples"


def sort_key(name: str) -> tuple[int, str]:
    """Order scripts by `ORDER`."""
    file = Path(name).name
    return (ORDER.index(file) if file in ORDER else len(ORDER), file)


def output_folder(gallery_conf: dict[str, Any], script_vars: dict[str, Any]) -> list[str]:
    """Give a script its one argument, the folder that it writes to."""
    folder = BUILD / Path(script_vars["src_file"]).stem
    for old in folder.glob("*.png"):
        old.unlink()
    return [str(folder)]


def scrape_pictures(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Show the pictures that a block of a script wrote, oldest first."""
    folder = BUILD / Path(block_vars["src_file"]).stem
    shown = block_vars.setdefault("shown_pictures", set())
    new = [path for path in folder.glob("*.png") if path not in shown]
    names = []
    for path in sorted(new, key=lambda p: (p.stat().st_mtime_ns, p.name)):
        shown.add(path)
        names.append(next(block_vars["image_path_iterator"]))
        with Image.open(path) as picture:
            times = -(-SMALLEST // picture.width)
            size = (times * picture.width, times * picture.height)
            picture.resize(size, Image.Resampling.NEAREST).save(names[-1])
    return figure_rst(names, gallery_conf["src_dir"])
