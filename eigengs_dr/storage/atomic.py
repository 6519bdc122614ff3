"""Writing a file whole or not at all."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Replace a file in one step: write to the path that is given, beside the target.

    Readers see the old file or the new one, never a part of it, also after a crash.

    Parameters
    ----------
    path : str or os.PathLike
        The target, which may exist; its folder must. A symbolic link is followed.

    Yields
    ------
    Path
        An empty temporary file with the target's suffix. When the block ends it is flushed to disk
        and renamed; when the block raises it is removed and the target stays as it was.

    Raises
    ------
    OSError
        If the folder is missing or may not be written, the target is a folder or a device, or the
        disk is full; it names the target.

    Examples
    --------
    >>> with replacing("/tmp/note.txt") as temporary:
    ...     _ = temporary.write_text("whole")
    """
    target = _target(path)
    temporary = target.with_name(f".{secrets.token_hex(8)}{target.suffix}")
    # touch() rather than tempfile, whose files only their owner may read.
    temporary.touch(exist_ok=False)
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (None, str(temporary)):
            # A full disk is reported without a name, or with that of the temporary file.
            raise OSError(error.errno, error.strerror or str(error), str(path)) from error
        raise


def require_writable(path: str | os.PathLike[str]) -> None:
    """Check that `atomic_write` will be able to write a file, before long work depends on it.

    Parameters
    ----------
    path : str or os.PathLike
        The file that is to be written.

    Raises
    ------
    OSError
        One line that names the file and says why it cannot be written.
    """
    target = _target(path)
    probe = target.with_name(f".{secrets.token_hex(8)}{target.suffix}")
    try:
        # A look at the mode bits would miss read-only disks, quotas and access lists.
        probe.touch(exist_ok=False)
        probe.unlink()
    except OSError as error:
        reason = f"no file can be made in {target.parent} ({error.strerror})"
        raise OSError(f"{path}: {reason}; choose another path") from error


def _target(path: str | os.PathLike[str]) -> Path:
    """Where a path leads; refuses what must not be renamed over, such as /dev/null."""
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        kind = "a folder" if target.is_dir() else "a device"
        raise OSError(f"{path}: is {kind}; choose another path")
    return target
