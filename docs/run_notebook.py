"""Run the notebook of the manual and store small outputs: ``python docs/run_notebook.py``.

Pictures become small JPEG files. A page of `eigengs_dr.view` needs a browser and is large: its text
stays. The build of the manual runs the notebook again, and shows all of it.
"""

import re
from base64 import b64decode, b64encode
from io import BytesIO
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image

NOTEBOOK = Path(__file__).parent / "notebook.ipynb"
SIDE, QUALITY = 320, 80  # pixels; of JPEG
PICTURE = re.compile(r"data:image/\w+;base64,([^\"]+)")


def main() -> None:
    """Run all cells and write the notebook with what they show."""
    book = nbformat.read(NOTEBOOK, 4)
    metadata = dict(book.metadata)
    NotebookClient(book, kernel_name="python3", record_timing=False).execute()
    book.metadata = metadata  # without the versions of this machine
    for cell in book.cells:
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if output.output_type != "stream"]
            for output in cell.outputs:  # but for bars of progress
                shrink(output.get("data", {}))
    nbformat.write(book, NOTEBOOK)


def shrink(shown: dict[str, str]) -> None:
    """Make the pictures of an output small, or drop its page."""
    html = shown.pop("text/html", "")
    if html and "<iframe" not in html:
        shown["text/html"] = PICTURE.sub(smaller, html)


def smaller(found: re.Match[str]) -> str:
    """Return the data URI of a picture of at most `SIDE` pixels."""
    picture = Image.open(BytesIO(b64decode(found[1]))).convert("RGB")
    picture.thumbnail((SIDE, SIDE))
    file = BytesIO()
    picture.save(file, "jpeg", quality=QUALITY)
    return f"data:image/jpeg;base64,{b64encode(file.getvalue()).decode()}"


if __name__ == "__main__":
    main()
