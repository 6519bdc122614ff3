"""A run: its images, the manifest of its output folder, and where its work is done."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

from ..backend.executor import executor_for
from .dispatch import dispatch
from .manifest import Manifest
from .row import Finished
from .run import Job, run_job
from .sources import Images, Source, list_sources, make_folder, plan_output

Loop = Callable[..., Generator[Finished, None, None]]
"""``loop(sources, job, start=start)`` yields an entry for each source."""


def run_images(
    images: Images,
    output: str | os.PathLike[str] | None,
    overwrite: bool,
    job: Job,
    client: Any = None,
) -> tuple[int | None, Generator[Finished, None, None]]:
    """Prepare a run; see `eigengs_dr.fit_many` for arguments and errors.

    Returns
    -------
    total : int or None
        Number of images, if it is known.
    finished : generator of Finished
        One for each image, whose result is written before. In this process they are in order.
    """
    sources = list_sources(images)
    total = len(sources) if isinstance(sources, list) else None
    loop: Loop = run_job
    if client is None:
        _ = job.work  # what is wrong with the options is said before the work
    else:
        loop = partial(
            dispatch, executor=executor_for(client), total=total, keep_results=output is None
        )
    if output is None:
        return total, loop(sources, job, start=lambda names: None)
    return total, _recorded(sources, job, make_folder(output), overwrite, loop)


def _recorded(
    sources: Iterable[Source], job: Job, output: Path, overwrite: bool, loop: Loop
) -> Generator[Finished, None, None]:
    """Leave out what the manifest says is done, and record the rest in it."""
    with Manifest(output) as manifest:
        planned = (plan_output(source, manifest, overwrite) for source in sources)
        with closing(loop(planned, job, start=manifest.start)) as finished:
            for entry in finished:
                manifest.add(entry.row)
                yield entry
