"""What sphinx-gallery calls: the order of the tutorials, and the pictures that they wrote.

After ``make docs``, ``python tools/manual/gallery.py`` writes the pictures of examples/README.md.
"""

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

ROOT = Path(__file__).parents[2]
BUILD = ROOT / "build" / "docs" / "examples"

HEIGHT, WIDTH, GAP = 160, 800, 4  # pixels: of a strip at most, and white between two pictures


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


def write_strips() -> None:
    """Write the pictures of each script side by side, in examples/images/."""
    folder = ROOT / "examples" / "images"
    folder.mkdir(exist_ok=True)
    for script in sorted((ROOT / "examples").glob("*.py")):
        files = sorted((BUILD / script.stem).glob("*.png"), key=lambda p: p.stat().st_mtime_ns)
        pictures = [Image.open(file).convert("RGB") for file in files]
        shown = [p.resize((p.width * HEIGHT // p.height, HEIGHT)) for p in pictures]
        strip = Image.new("RGB", (sum(p.width + GAP for p in shown) - GAP, HEIGHT), "white")
        left = 0
        for picture in shown:
            strip.paste(picture, (left, 0))
            left += picture.width + GAP
        strip.thumbnail((WIDTH, HEIGHT))
        strip.save(folder / f"{script.stem}.jpg", quality=85, optimize=True)


if __name__ == "__main__":
    write_strips()
