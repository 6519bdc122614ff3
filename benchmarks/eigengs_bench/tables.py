"""The paper's tables on sets of images: every method on every image, step by step.

A row has "job" with set, image, iterations, gaussians and the fields of `Method`, and "moments",
rows of the trace of a fit.

Tai et al., "EigenGS Representation", CVPR 2025: tables 1 (FFHQ) and 3 (ablation).
"""

from collections.abc import Iterator, Sequence
from functools import cache, partial
from importlib.resources import files
from typing import Any, NamedTuple

import pandas as pd

from eigengs_bench import report as fr
from eigengs_bench.clock import METHODS, Image, trace_of, warm_up
from eigengs_bench.images import images_of, is_trained, model_for
from eigengs_bench.names import NATURAL, SETS, TABLES
from eigengs_bench.rows import Job, Row, Task

# Iterations of the paper's tables, and 0 and 10.
ITERATIONS = (0, 10, 100, 500, 1000, 5000, 10000)
COMPONENTS = (300, 500)  # components per channel in the paper's tables


class Method(NamedTuple):
    """A method by its name, and the model it starts from.

    The model is of the training images of `source`, "" for none.
    """

    preset: str
    source: str = ""
    components: int = 0
    space: str = "ycbcr"
    split: str = "auto"  # or "split" or "whole": frequency_aware of EigenGS.fit


def methods(name: str, table: str, sources: Sequence[str]) -> list[Method]:
    """List the methods that a table compares on a set; `sources` are the sets with a basis."""
    trained = [name] if name in sources else []
    universal = [NATURAL] if NATURAL in sources and name != NATURAL else []
    count = COMPONENTS[0]
    if table == "ablation":
        pairs = [(color, split) for color in ("ycbcr", "rgb") for split in ("split", "whole")]
        return [Method("eigengs", name, count, *pair) for _ in trained for pair in pairs]
    bases = [Method("eigengs", source, k) for source in trained + universal for k in COMPONENTS]
    return [Method("gaussianimage"), Method("default"), *bases]


def run(task: Task, names: Sequence[str], tables: Sequence[str]) -> list[Row]:
    """Measure what the tables need on sets, image by image, the methods in turn."""
    rows, sources = list[Row](), [name for name in SETS if is_trained(task, name)]
    for name in names:
        compared = [m for table in tables or TABLES for m in methods(name, table, sources)]
        jobs = list(_jobs(task, name, list(dict.fromkeys(compared))))
        rows += task.measure("tables", jobs, name)
    return rows


def _jobs(task: Task, name: str, compared: Sequence[Method]) -> Iterator[Job]:
    pictures = images_of(task, name)
    marks = {mark for mark in ITERATIONS if mark < task.iterations} | {task.iterations}

    @cache
    def options_of(method: Method) -> dict[str, Any]:
        """Return the options of fits, after training their model and compiling, untimed."""
        model, count = None, None if method.source else SETS[name].gaussians
        if method.source:
            split = {"split": True, "whole": False}.get(method.split, "auto")
            model = model_for(task, name, method.source, method.components, method.space, split)
        options: Row = {"method": METHODS[method.preset], "space": method.space, "start": model}
        options |= {"gaussians": count, "backend": task.backend}
        warm_up(pictures[0][1], task.iterations, **options)
        return options

    def work(method: Method, image: Image) -> Row:
        return {"moments": trace_of(image, task.iterations, marks, **options_of(method))}

    shared = {"set": name, "iterations": task.iterations, "gaussians": SETS[name].gaussians}
    for file, image in pictures:
        for method in compared:
            yield {**shared, "image": file, **method._asdict()}, partial(work, method, image)


# ---------------------------------------------------------------------------------------------
#  The tables, and the figures that the paper prints
# ---------------------------------------------------------------------------------------------

KEY = ["set", "iterations", *Method._fields]


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Make a table for each kind and number of steps.

    A line is a set and a method, or a setting of the ablation: means over the images. What the
    paper prints stands beside them in brackets.
    """
    fits, tables = fr.frame_of(rows, "moments"), []
    for length in sorted(fits.iterations.unique()):
        for kind in TABLES:
            chosen = _chosen(fits[fits.iterations == length], kind)
            if chosen.method.nunique() > 1:
                shown = set(chosen[KEY].itertuples(index=False, name=None))
                used = [row for row in rows if tuple(row["job"][k] for k in KEY) in shown]
                made = _ablation(chosen) if kind == "ablation" else _few(chosen)
                tables.append(made._replace(name=f"{kind}_{length}", rows=used))
    return fr.Section(tables)


def _published(name: str) -> pd.DataFrame:
    """Read figures that the paper prints."""
    return pd.read_csv(str(files("eigengs_bench") / f"published_{name}.csv"), dtype=str).fillna("")


def _chosen(fits: pd.DataFrame, kind: str) -> pd.DataFrame:
    """Choose the fits of a kind of table, with a column "method"."""
    parts = []
    for name, some in fits.groupby("set", sort=False):
        labels = {m: label(m, str(name)) for m in methods(str(name), kind, list(SETS))}
        keys = some[list(Method._fields)].itertuples(index=False, name=None)
        some = some.assign(method=[labels.get(Method(*key)) for key in keys])
        parts.append(some.dropna(subset="method"))
    return pd.concat(parts)


def label(method: Method, name: str) -> str:
    """Name a method on a set, for readers."""
    if not method.source:
        return method.preset
    basis = {NATURAL: "universal", name: "own"}.get(method.source, method.source)
    text = f"{method.preset}, {method.components} components, {basis} basis"
    return text if method.split == "auto" else f"{method.preset}, {method.space}, {method.split}"


SHOWN = (0, 100, 1000, 10000)


def _few(fits: pd.DataFrame) -> fr.Table:
    """Lay out PSNRs by steps, and seconds, for bases with the paper's 300 components."""
    printed = {(ln["set"], ln["source"]): ln for ln in _published("steps").to_dict("records")}
    fits = fits[fits.components.isin([0, COMPONENTS[0]])]
    steps, lines = [n for n in SHOWN if n in set(fits.iteration)], list[tuple[str, ...]]()
    for (name, method), part in fits.groupby(["set", "method"], sort=False):
        source, ours = part.source.iloc[0], part.preset.iloc[0] == "default"
        paper = {} if ours else printed.get((name, source), {})
        first = "" if str(name) in {line[0] for line in lines} else str(name)
        cells = [
            fr.mean(part[part.iteration == n].psnr_ycbcr) + _bracket(paper.get(str(n), ""))
            for n in steps
        ]
        text = str(method).replace(f", {COMPONENTS[0]} components", "")
        last = part[part.iteration == part.iterations]
        lines.append((first, text, *cells, fr.median(last.seconds)))
    caption = (
        f"PSNR in YCbCr in dB by steps, in brackets the paper's for {_sets(fits)}; median seconds "
        f"of a fit; {fr.counted(fits.image)} per set"
    )
    return fr.table(caption, ("set", "method", *(f"{n:,}" for n in steps), "s"), lines)


def _sets(fits: pd.DataFrame) -> str:
    """Name the paper's sets that correspond to ours."""
    printed = _published("steps").drop_duplicates("set")
    return ", ".join(printed[printed.set.isin(fits.set.unique())].images)


def _ablation(fits: pd.DataFrame) -> fr.Table:
    """Lay out colour space and split as in the paper: a line per setting, a column per set."""
    last, printed = fits[fits.iteration == fits.iterations], _published("ablation")
    names, lines = list(last.set.unique()), []
    for line in printed.to_dict("records"):
        some = last[(last.space == line["space"]) & (last.split == line["split"])]
        sets = [some[some.set == name] for name in names]
        cells = [
            f"{fr.mean(part.psnr_ycbcr)} / {fr.mean(part.psnr_rgb)}{_bracket(line.get(name, ''))}"
            for name, part in zip(names, sets, strict=True)
        ]
        lines.append((f"{line['space']}, {line['split']}", *cells))
    caption = (
        f"psnr_ycbcr / psnr_rgb in dB after {last.iterations.max():,} steps of eigengs, by the "
        "space of the descent and the frequency-aware split; in brackets the paper's one PSNR "
        f"after 10,000 steps; {fr.counted(last.image)} per set"
    )
    return fr.table(caption, ("fitted in", *names), lines)


def _bracket(printed: str) -> str:
    return f" ({printed})" if printed not in ("", "-") else ""
