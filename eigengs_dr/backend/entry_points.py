"""The entry points of the package: their numbers, progress bars, and the lock of Dr.Jit.

Each public function that uses Dr.Jit is one, and so are the public methods of some classes.
Functions that are only called from entry points need no lock. Work that starts elsewhere takes
`eigengs_dr.exclusive` itself: a group of images, a block, a task of a cluster.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from functools import wraps
from importlib import import_module
from importlib.util import find_spec
from inspect import isfunction, signature
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, TypeVar, cast

from .messages import shown

if TYPE_CHECKING:
    from .types import Record

Function = TypeVar("Function", bound=Callable[..., object])
Kind = TypeVar("Kind", bound=type)


def entry_point(function: Function) -> Function:
    """Decorate a public function that uses Dr.Jit.

    No other thread uses Dr.Jit during a call. Without the lock, threads crash the process or hang,
    see `eigengs_dr.backend.recording`. NumPy numbers are accepted, see `checks_types`. Errors of
    functions of the user pass as they are.
    """
    plain = checks_types(function)

    @wraps(function)
    def call(*values: object, **options: object) -> object:
        from .recording import exclusive  # loads Dr.Jit, which `--help` does not need

        with exclusive():
            try:
                return plain(*values, **options)
            except RuntimeError as error:
                if isinstance(error.__cause__, StopIteration):  # generators change its type
                    raise error.__cause__ from None
                raise

    return cast(Function, call)


def class_of_entry_points(kind: Kind) -> Kind:
    """Decorate a class: its public methods and ``[...]`` are entry points, properties are not."""
    for name, member in list(vars(kind).items()):
        if name.startswith("_") and name != "__getitem__":
            continue
        if isinstance(member, classmethod):
            setattr(kind, name, classmethod(entry_point(member.__func__)))
        elif isfunction(member):
            setattr(kind, name, entry_point(member))
    return kind


# For annotations that are checked: the classes that are accepted, or what these have; in messages.
# Classes stand by their names, since importing them here would load Dr.Jit and NumPy.
KINDS = {
    "int": ("", "a whole number"),
    "float": ("", "a number"),
    "bool": ("bool bool_", "True or False"),
    "str": ("str", "a string"),
    "str | os.PathLike[str]": ("str __fspath__", "a path"),
    "PathLike": ("str __fspath__", "a path"),
    "Images": ("__fspath__ __iter__ __getitem__", "a path or several images"),
    "TrainingImages": ("__fspath__ __iter__ __getitem__", "a path or several images"),
    "Sequence[TextureMap]": ("__iter__", "the name, space and channels of each map"),
    "Mapping[str, Tensor]": ("keys", "a mapping of names to tensors"),
    "Mapping[str, object]": ("keys", "parameters, as of mitsuba.traverse"),
    "mi.SceneParameters": ("keys", "parameters, as of mitsuba.traverse"),
    "mi.Sensor": ("Sensor", "a sensor of Mitsuba"),
    "Texture": ("Object", "a texture, an emitter or a BSDF of Mitsuba"),
    "TileLists": ("TileLists", "the result of eigengs_dr.tile_lists"),
    "Gaussians": ("Gaussians", "a set of Gaussians"),
    "Sequence[Gaussians]": ("", "a list of sets of Gaussians"),
    "Sequence[int]": ("", "a list of whole numbers"),
}


def _accepts(kind: str, value: Any) -> bool:
    """Return whether a value is of a kind."""
    if kind in ("int", "float"):  # NumPy registers its numbers, but not its booleans
        return not isinstance(value, bool) and isinstance(
            value, Integral if kind == "int" else Real
        )
    if kind in ("Sequence[int]", "Sequence[Gaussians]"):
        return hasattr(value, "__len__") and all(_accepts(kind[9:-1], one) for one in value)
    classes = {base.__name__ for base in type(value).__mro__}
    return any(name in classes or hasattr(value, name) for name in KINDS[kind][0].split())


def check_types(values: Mapping[str, object], annotations: Mapping[str, str]) -> Record:
    """Return those of named values whose annotations are in `KINDS`; refuse other types.

    Numbers become Python numbers: those of NumPy would promote Dr.Jit arrays to double precision,
    and JSON cannot store them.

    Parameters
    ----------
    values : mapping of str to object
    annotations : mapping of str to str
        Annotations of the values, optionally with "| None".

    Raises
    ------
    TypeError
        If a value has another type than its annotation.
    """
    checked: Record = {}
    for name, value in values.items():
        kind = _kind_of(annotations.get(name))
        if kind in KINDS and (value is not None or kind == annotations[name]):
            if not _accepts(kind, value):
                raise TypeError(f"{name} is {shown(value)}; it must be {KINDS[kind][1]}")
            numbers: Record = {"int": int, "float": float}
            checked[name] = numbers[kind](value) if kind in numbers else value
    return checked


def _kind_of(annotation: object) -> str:
    return str(annotation).removesuffix(" | None")


def check_fields(record: Any, **ranges: str) -> None:
    """Let the fields of a frozen dataclass be plain numbers, each in its range.

    Parameters
    ----------
    record : dataclass
    ranges : str
        The range of each field that is checked, such as "[0, 1)".

    Raises
    ------
    TypeError
        If a field is no number.
    ValueError
        If a field is not finite, or out of range.
    """
    kinds = {field.name: str(field.type) for field in fields(record) if field.name in ranges}
    kind = type(record).__name__
    try:
        plain = check_types(vars(record), kinds)
    except TypeError as error:
        raise TypeError(f"{kind}: {error}") from None
    for name, value in plain.items():
        low, high = map(float, ranges[name][1:-1].split(","))
        inside = low < value < high or value == (low if ranges[name][0] == "[" else None)
        inside |= value == (high if ranges[name][-1] == "]" else None)
        if not (inside and math.isfinite(value)):
            raise ValueError(f"{kind}: {name} is {value}; it must be in {ranges[name]}")
        object.__setattr__(record, name, value)


def checks_types(function: Function) -> Function:
    """Decorate a function whose arguments `check_types` checks; NumPy numbers become Python's."""
    arguments = signature(function)
    annotations = {name: p.annotation for name, p in arguments.parameters.items()}
    if not any(_kind_of(annotation) in KINDS for annotation in annotations.values()):
        return function

    @wraps(function)
    def call(*values: object, **options: object) -> object:
        try:
            bound = arguments.bind(*values, **options)
        except TypeError as error:  # as Python says it, which names the function
            raise TypeError(f"{function.__qualname__}() {error}") from None
        bound.arguments.update(check_types(bound.arguments, annotations))
        return function(*bound.args, **bound.kwargs)

    return call  # type: ignore[return-value]


DELAY = 2.0
"""Seconds before a bar appears."""

Progress = Callable[..., None] | bool | None
"""Values of the argument ``progress``, see `shows_progress`."""


def shows_progress(function: Function) -> Function:
    """Decorate a function with an argument ``progress``, so that it shows a progress bar.

    None and True show a bar after `DELAY` seconds, in a notebook or if standard error is a
    terminal. False shows nothing. A function is called as ``progress(done, total, row)``.
    """
    arguments = signature(function)

    @wraps(function)
    def call(*values: object, **options: object) -> object:
        bound = arguments.bind(*values, **options)
        with progress_bar(bound.arguments.get("progress"), function.__name__) as show:
            bound.arguments["progress"] = show
            return function(*bound.args, **bound.kwargs)

    return call  # type: ignore[return-value]


@contextmanager
def progress_bar(progress: Progress = None, name: str = "") -> Iterator[Callable[..., None] | None]:
    """Show a bar during a block, and yield a function that updates it.

    Parameters
    ----------
    progress : bool or callable, optional
        See `shows_progress`.
    name : str, optional
        Text before the bar.

    Yields
    ------
    callable or None
        ``show(done, total, row)``, optionally with a label as the first argument, by default that
        of the row, see `label_of`; a new label restarts the bar. The bar shows ``psnr_rgb`` of the
        row, or its loss; the row may be left out. None if no bar is visible.
    """
    if callable(progress):
        yield progress
        return
    if not (progress is None or isinstance(progress, bool)):
        raise TypeError(f"progress is {shown(progress)}; pass True, False or a function")
    if progress is False or not _is_watched():
        yield None
        return
    # A notebook without widgets shows text; tqdm.auto would warn about it.
    tqdm = import_module("tqdm.auto" if find_spec("ipywidgets") else "tqdm").tqdm

    with tqdm(desc=name, delay=DELAY, leave=False) as bar:

        def show(*values: Any) -> None:
            label = ""
            if isinstance(values[0], str):
                label, *values = values  # type: ignore[assignment]
            done, total, *rest = values
            row = rest[0] if rest else None
            figures = row if isinstance(row, dict) else {"psnr_rgb": getattr(row, "psnr_rgb", None)}
            label = label or label_of(figures)
            if label and label != bar.desc:
                bar.set_description_str(label, refresh=False)
                bar.set_postfix_str("", refresh=False)
                if bar.n:  # otherwise the bar would appear at once
                    bar.reset()
            bar.total = total
            if figures.get("psnr_rgb") is not None:
                bar.set_postfix_str(f"psnr_rgb {figures['psnr_rgb']:.2f} dB", refresh=False)
            elif "loss" in figures:
                bar.set_postfix_str(f"loss {figures['loss']:.4g}", refresh=False)
            bar.update(done - bar.n)

        yield show


def label_of(row: Record) -> str:
    """Return the image and the stage that a row of progress names, if it names any."""
    return ": ".join(row[key] for key in ("image", "stage") if key in row)


def _is_watched() -> bool:
    """Return whether a bar is visible, in a notebook or in a terminal."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    if shell is not None and hasattr(shell, "kernel"):
        return True
    try:
        return bool(sys.stderr.isatty())
    except (AttributeError, ValueError):  # there is none, it has no such method, or it is closed
        return False
