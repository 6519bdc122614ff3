"""Run the notebook of the manual and store small outputs: ``python tools/manual/run_notebook.py``.

Pictures become JPEG files, which any viewer of notebooks shows. A page of `eigengs_dr.view` needs a
browser and is large: its text stays. The build of the manual runs the notebook again, and shows all
of it.
"""

import re
from base64 import b64decode, b64encode
from io import BytesIO
from pathlib import Path

import nbformat
import numpy as np
from nbclient import NotebookClient
from PIL import Image

NOTEBOOK = Path(__file__).parents[2] / "docs" / "notebook.ipynb"
WIDTH, QUALITY = 960, 80  # pixels, at most; of JPEG
PICTURE = re.compile(r"<img src=\"data:image/\w+;base64,([^\"]+)")


def main() -> None:
    """Run all cells and write the notebook with what they show."""
    book = nbformat.read(NOTEBOOK, 4)
    metadata = dict(book.metadata)
    NotebookClient(book, kernel_name="python3", record_timing=False).execute()
    book.metadata = metadata  # without the versions of this machine
    for cell in book.cells:
        if cell.cell_type == "code":  # without bars of progress
            cell.outputs = [output for output in cell.outputs if output.output_type != "stream"]
            for output in cell.outputs:
                shrink(output.get("data", {}))
    nbformat.write(book, NOTEBOOK)


def shrink(shown: dict[str, str]) -> None:
    """Replace the HTML of an output by its pictures, side by side."""
    codes = PICTURE.findall(shown.pop("text/html", ""))
    pictures = [Image.open(BytesIO(b64decode(code))).convert("RGB") for code in codes]
    if pictures:
        row = Image.fromarray(np.hstack([np.asarray(picture) for picture in pictures]))
        row.thumbnail((WIDTH, WIDTH))
        file = BytesIO()
        row.save(file, "jpeg", quality=QUALITY)
        shown["image/jpeg"] = b64encode(file.getvalue()).decode()


if __name__ == "__main__":
    main()
