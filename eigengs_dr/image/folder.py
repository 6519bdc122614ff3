"""Families of images in folders, files, arrays or iterators, read in blocks of bounded memory."""

from __future__ import annotations

import glob
import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..backend.messages import warn
from ..backend.types import PathLike, Record, Values
from .formats import READ_SUFFIXES, UNREAD_SUFFIXES
from .io import check_member
from .notes import NotedImages, kept_notes, tell_all
from .pixels import ImageError, available_cores, check_size, is_bitmap, is_drjit, local_path
from .resize import center_crop
from .space import FAMILY_SPACES, space_of, to_planes

THREADS = min(8, available_cores())
"""Number of threads that decode files; Pillow and NumPy release the interpreter lock."""

MAX_WAITING, MAX_WAITING_BYTES = 512, 1 << 25
"""Largest number of decoded images that wait in memory, and their total bytes, estimated from the
largest image so far. One image may always wait."""

MAX_NAMED = 3
"""Largest number of files that a warning names."""

FileOrImage = PathLike | Values

TrainingImages = FileOrImage | Iterable[FileOrImage]
"""A folder, an array of images, or an iterable of files and such arrays."""

ReadProgress = Callable[[int, int | None, Record], None]
"""``progress(done, total, row)``; the total is None if it is unknown."""


class PreparedImage(NamedTuple):
    """One image of a block, or the reason why it could not be read.

    Attributes
    ----------
    planes : ndarray of float32, shape (3, d), or None
    fitted : bool
        Whether the image was cropped and resized.
    problem : str
        Name of the file and the reason; empty if `planes` is not None.
    """

    planes: NDArray[np.float32] | None
    fitted: bool
    problem: str = ""


def image_files(folder: str | Path, recursive: bool = False) -> list[Path]:
    """List the images of a folder, without hidden files and folders.

    Parameters
    ----------
    folder : str or Path
    recursive : bool, optional
        Whether to list those in its subfolders too; links to folders are not followed.

    Returns
    -------
    list of Path
        Files with a suffix of `READ_SUFFIXES` in upper or lower case, sorted by path.

    Warns
    -----
    UserWarning
        If files with a suffix of `UNREAD_SUFFIXES` are left out, or images in subfolders.

    Raises
    ------
    ImageError
        If the folder does not exist, is a file, or holds no image.
    """
    folder = Path(folder)
    try:
        entries = sorted(folder.iterdir())
    except NotADirectoryError:
        raise ImageError(f"{folder}: is a file; give the folder that holds it") from None
    except OSError as error:
        raise ImageError(f"{folder}: not a readable folder ({error.strerror}); check it") from None
    deeper = (path for entry in entries if entry.is_dir() for path in _walk(entry))
    if recursive:
        entries = sorted([*entries, *deeper])
    entries = [entry for entry in entries if entry.name[0] != "." and entry.is_file()]
    files = [entry for entry in entries if entry.suffix.lower() in READ_SUFFIXES]
    left_out = next((path for path in deeper if path.suffix.lower() in READ_SUFFIXES), None)
    if left_out:
        warn(
            f"{folder}: images in its subfolders are left out, such as "
            f"{left_out.relative_to(folder)}; fit takes them with --recursive (recursive=True)"
        )
    skipped = [entry.name for entry in entries if entry.suffix.lower() in UNREAD_SUFFIXES]
    if skipped:
        warn(f"{folder}: {len(skipped)} files of unsupported kinds are left out: {_names(skipped)}")
    if not files:
        known = " ".join(READ_SUFFIXES)
        raise ImageError(f"{folder}: holds no images; expected files ending in {known}")
    return files


def _walk(folder: Path) -> Iterator[Path]:
    """Yield the files in a folder and below, except hidden ones."""
    if folder.name[0] == "." or folder.is_symlink():
        return
    for place, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if name[0] != ".")
        yield from (Path(place, name) for name in sorted(names) if name[0] != ".")


def _names(names: list[str]) -> str:
    """Return the first names of a list as text."""
    return ", ".join(names[:MAX_NAMED]) + (", ..." if len(names) > MAX_NAMED else "")


def list_images(images: str | os.PathLike[str], recursive: bool = False) -> list[Path]:
    """List the images of a folder or a glob.

    Parameters
    ----------
    images : path-like
    recursive : bool, optional
        Whether to list those in the subfolders of a folder too.

    Returns
    -------
    list of Path
        Sorted by name.

    Raises
    ------
    ImageError
        If there are no images, or a pattern is given that should be recursive.
    OSError
        If a URL is given.
    """
    folder = local_path(images)
    if glob.has_magic(os.fspath(images)) and not os.path.exists(images):
        if recursive:
            raise ImageError(f"{images}: recursive is for a folder; write ** into the pattern")
        files = sorted(Path(name) for name in glob.glob(os.fspath(images), recursive=True))
        if not files:
            raise ImageError(f"{images}: no file matches; check the pattern")
        return files
    return image_files(folder, recursive)


def find_lists(folder: PathLike) -> list[Path]:
    """Return the lists of lights (.lp) in a folder, without hidden files; OSError if it is none."""
    files = sorted(file for file in Path(folder).iterdir() if file.suffix.lower() == ".lp")
    return [file for file in files if file.name[0] != "." and file.is_file()]


def read_blocks(
    source: TrainingImages,
    size: tuple[int, int],
    space: str,
    length: int,
    progress: ReadProgress | None = None,
    encoding: str | None = None,
) -> Generator[NDArray[np.float32], None, None]:
    """Read images in blocks, in the order of the source.

    Every `length` consecutive images of the source form one block; files that cannot be read are
    left out. A run that stopped after n blocks can continue with image ``n * length`` of the
    source.

    Parameters
    ----------
    source : path, array or iterable
        A folder, an array of images (n, H, W, 3) or (n, H, W), or an iterable of files,
        arrays of images, RGB images (H, W, 3), or ``mitsuba.Bitmap``. Pixels as for
        `eigengs_dr.image.io.check_member`. An iterator may overwrite an array when the next one is
        requested.
    size : (int, int)
        Width and height in pixels. Images of another size are centre-cropped and resized.
    space : {"ycbcr", "rgb"}
        Colour space of the result.
    length : int
        Largest number of images in a block.
    progress : callable, optional
        ``progress(done, total, {})`` after every image; `total` is None for an iterator.
    encoding : {"srgb", "linear"}, optional
        The encoding of all pixels.

    Yields
    ------
    ndarray of float32, shape (b, 3, height * width)
        0 <= b <= length. The caller may overwrite the block, and should delete it before it
        requests the next one: otherwise two blocks are in memory.

    Raises
    ------
    ImageError
        If the source has no images, none of its files can be read, or an array is not an image.
    ValueError
        If the size or the space is invalid.

    Warns
    -----
    UserWarning
        At the end, with the number of skipped images and the first names, and the number of resized
        images.
    """
    size = check_size(size)
    space = space_of(space, FAMILY_SPACES)
    if isinstance(source, str | os.PathLike):
        source = list_images(source)
    elif isinstance(source, np.ndarray) or is_drjit(source):
        source = [source]  # type: ignore[list-item]
    total = None
    if isinstance(source, Sequence):
        total = sum(1 if _is_file(item) else len(_images(item)) for item in source)
    images = read_ahead(
        enumerate(_singles(source)),
        partial(_prepare, size=size, space=space, encoding=encoding),
        lambda numbered: _is_file(numbered[1]),
        lambda image: 0 if image.planes is None else image.planes.nbytes,
    )
    return _blocks(images, size, length, total, progress)


def _blocks(
    images: Generator[PreparedImage, None, None],
    size: tuple[int, int],
    length: int,
    total: int | None,
    progress: ReadProgress | None,
) -> Generator[NDArray[np.float32], None, None]:
    """Collect images in blocks, and warn about skipped and resized images at the end."""
    pixels = size[0] * size[1]
    done = fitted = 0
    problems: list[str] = []
    with closing(images):
        while True:
            block = np.empty((min(length, total or length), 3, pixels), np.float32)
            before, filled = done, 0
            for image in islice(images, length):
                if image.planes is None:
                    problems.append(image.problem)
                else:
                    block[filled] = image.planes
                    filled += 1
                done += 1
                fitted += image.fitted
                if progress:
                    progress(done, total, {})
            if done == before:
                break
            yield block[:filled]
            del block  # frees the memory before the next block is allocated
    if done == 0:
        raise ImageError("the source holds no images; check the source")
    if len(problems) == done:
        raise ImageError(
            f"none of {done} images can be read, for example {problems[0]}; check the files"
        )
    if problems:
        warn(f"{len(problems)} of {done} images were skipped: {_names(problems)}")
    if fitted:
        warn(f"{fitted} of {done} images were centre-cropped and resized to {size[0]}x{size[1]}")


Item = TypeVar("Item")
Read = TypeVar("Read")


def read_ahead(
    items: Iterable[Item],
    read: Callable[[Item], Read],
    is_file: Callable[[Item], bool],
    bytes_of: Callable[[Read], int],
) -> Generator[Read, None, None]:
    """Read items in threads while the caller processes earlier ones.

    Parameters
    ----------
    items : iterable
    read : callable
        Returns the result for an item.
    is_file : callable
        Whether threads may read an item. Others are read at once, because the owner of an array
        may overwrite it when the next one is requested.
    bytes_of : callable
        Memory that a result takes, in bytes.

    Yields
    ------
    object
        Results in the order of the items. At most `MAX_WAITING`, and about `MAX_WAITING_BYTES`,
        wait.
    """
    waiting: deque[Future[tuple[Read, NotedImages]]] = deque()
    largest = 0
    pool = ThreadPoolExecutor(THREADS, thread_name_prefix="decode")

    def read_noted(item: Item) -> tuple[Read, NotedImages]:
        with kept_notes() as noted:
            return read(item), noted

    def first() -> Read:
        result, noted = waiting.popleft().result()
        tell_all(noted)  # in the thread and the order of the caller
        return result

    try:
        for item in items:
            if is_file(item):
                waiting.append(pool.submit(read_noted, item))
            else:
                waiting.append(Future())
                waiting[-1].set_result(read_noted(item))
            limit = MAX_WAITING_BYTES // largest if largest else THREADS
            while len(waiting) > min(max(1, limit), MAX_WAITING):
                result = first()
                largest = max(largest, bytes_of(result))
                yield result
                del result  # frees the memory before waiting for the next one
        while waiting:
            yield first()
    finally:
        pool.shutdown(cancel_futures=True)


def _singles(source: Iterable[FileOrImage]) -> Iterator[FileOrImage]:
    """Yield files and single images; arrays of images are split."""
    for item in source:
        if isinstance(item, str | os.PathLike):
            yield local_path(item)
        else:
            yield from _images(item)


def _prepare(
    numbered: tuple[int, Any], size: tuple[int, int], space: str, encoding: str | None
) -> PreparedImage:
    """Read, crop and convert one image."""
    place, item = numbered
    loaded = _is_file(item)
    try:
        image = check_member(item, encoding, f"image {place} of the source")
    except (ImageError, OSError) as error:
        if not loaded:
            raise ImageError(f"image {place} of the source{str(error)[len('image') :]}") from None
        # A warning lists several files, so each gets its name and the reason only.
        reason = str(error).removeprefix(f"{item}: ").split("; ")[0]
        return PreparedImage(None, False, f"{Path(item).name} ({reason})")
    width, height = size
    fitted = image.shape[:2] != (height, width)
    if fitted:
        image = center_crop(image, width, height)
    return PreparedImage(to_planes(image, space), fitted)


def _is_file(item: object) -> bool:
    return isinstance(item, str | os.PathLike)


def _images(item: Any) -> Sequence[Values]:
    """Return the images of an array as a sequence; a `mitsuba.Bitmap` is one."""
    if is_bitmap(item):
        return [item]
    if not (isinstance(item, np.ndarray) or is_drjit(item)) or item.ndim not in (3, 4):
        kind = f"shape {item.shape}" if isinstance(item, np.ndarray) else type(item).__name__
        raise ImageError(f"images: got {kind}, expected (n, H, W, 3) or (n, H, W); pass arrays")
    # A last axis of up to 4 holds channels, perhaps too many: no grey image is so narrow.
    return [item] if item.ndim == 3 and 1 <= item.shape[2] <= 4 else list(item)
