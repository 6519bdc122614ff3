"""Dr.Jit programs: one thread at a time; frozen programs take flat lists and are freed safely.

Dr.Jit 1.5 has process-wide state. While one thread records or replays a frozen program, another
thread that traces, differentiates, records or frees a program crashes the process, hangs it, or
makes the replay fail ("determining size of variable"). The lock of this module prevents this.

Other threads free arrays at any time, for example when Python drops a result, or a Dask worker a
message. They then hold Python's lock and wait for Dr.Jit's. A frozen call holds Dr.Jit's lock while
it traverses its arguments and builds its result. If Python code ran there, such as
`dataclasses.fields` or the ``__init__`` of a dataclass, Python might pass its lock to one of these
threads: a deadlock. Therefore a frozen program takes and returns only lists of arrays, which
Dr.Jit traverses without running Python code; `_flatten` and `_build` convert outside of the call.

Constants do not reach Dr.Jit either, because it confuses them: a program recorded with the numbers
16, 32, 0 was replayed for 16, 32, 16. Each set of constants has a program of its own.
"""

from __future__ import annotations

import atexit
import gc
import threading
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from functools import cache, wraps
from itertools import count
from typing import Any

import drjit as dr

from .arrays import kernel_misses, new_scope
from .types import DrJitArray

Program = Callable[..., Any]
"""A function of Dr.Jit arrays."""

Shape = tuple | None
"""The structure of a value without its arrays: None for an array; type and value of a constant;
type, names and shapes of the parts of a list, a dictionary or a dataclass."""

CONSTANTS = (int, float, bool, str, range)
"""Types of constants, besides None. A program is recorded for each value."""

_LOCK = threading.RLock()
"""The thread that holds it may use Dr.Jit."""

_retired: deque[Callable[[], None]] = deque()
"""Functions that free unused programs and arrays; `_clear_retired` calls them."""

_users: set[int] = set()
"""The threads that have asked for `_LOCK`."""

_blocks = 0
"""Number of open `exclusive` blocks of the thread that holds `_LOCK`."""

_calls = 0
"""Number of running calls of frozen programs, in the thread that holds `_LOCK`."""

_flushes = 0
"""Number of times that `drjit.flush_kernel_cache` was noticed, see `_count_flushes`."""
_misses: tuple[int, ...] = ()
"""`kernel_misses` when `_count_flushes` last looked."""
OUR_KERNEL = 0x2D6A55
"""A constant that makes a kernel unlike all others."""

_COLLECTOR_LOCK = threading.RLock()
_pauses = 0
"""Number of blocks, in all threads, that keep the garbage collector off."""
_collects = False
"""Whether the collector was enabled before the first of these blocks."""


@contextmanager
def exclusive() -> Iterator[None]:
    """Keep other threads from using Dr.Jit during a block, or during every call of a function.

    The functions of this package that use Dr.Jit, such as `eigengs_dr.fit` and
    `eigengs_dr.render`, do so by themselves. Use it around your own calls of Dr.Jit or Mitsuba,
    such as `drjit.backward` or `mitsuba.render`, if another thread may call this package at the
    same time. Blocks of one thread may nest. Scenes may be loaded in a block, because Mitsuba's
    loading threads need no lock. A block must not wait for another thread that waits for the lock.

    An error in a function that Dr.Jit calls, such as Ctrl-C in a loop, leaves the block as what it
    was, not as the `RuntimeError` that Dr.Jit makes of it.

    Returns
    -------
    context manager
        Also a decorator, ``@exclusive()``, of functions that are not generators.

    Examples
    --------
    >>> import eigengs_dr as eg
    >>> import drjit as dr
    >>> start = eg.fit(eg.sample("coffee")[:32, :32], gaussians=50, iterations=1).gaussians
    >>> with eg.exclusive():
    ...     dr.enable_grad(start.color)
    ...     dr.backward(dr.sum(eg.render(start).array))
    """
    if _is_guest():
        yield
        return
    global _blocks
    _users.add(threading.get_ident())
    with _LOCK:
        _clear_retired()
        kept = _living() if _blocks == 0 and len(_users) > 1 else []
        _blocks += 1
        try:
            yield
        except RuntimeError as error:
            if (first := _first_cause(error)) is error:
                raise
            raise first from first.__cause__
        finally:
            _blocks -= 1
            kept.clear()
            _clear_retired()


_kept: set[type] = set()
"""Types of pointers to the objects that every `exclusive` block keeps alive."""

NONE = 0xFFFFFFFF
"""A number that no object has."""


def keep_objects(pointers: Iterable[type]) -> None:
    """Let no thread free an object of a class with virtual calls during an `exclusive` block.

    Dr.Jit records a call for all objects of a class in the process, one after the other, and ends
    the process or reads freed memory if one is freed meanwhile. Mitsuba renders without Python's
    lock, so another thread that drops a scene does not wait for it.

    Parameters
    ----------
    pointers : iterable of type
        Dr.Jit's types of pointers to the classes, such as ``mitsuba.BSDFPtr``.
    """
    _kept.update(pointers)


def _living() -> list[object]:
    """Return all objects of the classes of `keep_objects`. Dr.Jit numbers them from 1."""
    found = []
    for pointer in tuple(_kept):
        number_type = dr.uint32_array_t(pointer)
        try:
            dr.reinterpret_array(pointer, number_type(NONE))[0]  # fails if there ever was one
        except RuntimeError:
            with suppress(RuntimeError):  # after the last one
                for number in count(1):
                    found.append(dr.reinterpret_array(pointer, number_type(number))[0])
    return found  # None for numbers that are free


def _first_cause(error: BaseException) -> BaseException:
    """Return what was raised in a function that Dr.Jit called, which it makes a `RuntimeError`.

    It may be Ctrl-C, or come from an alarm, from another thread or from a function of the user.
    Messages of Dr.Jit refer to it by "(see above)"; other errors with a cause stay as they are.
    """
    while type(error) is RuntimeError and error.__cause__ and "(see above)" in str(error):
        error = error.__cause__
    return error


_guests = threading.local()
"""``here`` counts the open `guest` blocks of a thread."""


@contextmanager
def guest() -> Iterator[None]:
    """Use Dr.Jit on behalf of a thread that waits for this one, without taking the lock.

    Mitsuba creates the objects of a scene in the threads of Dr.Jit's pool, and the caller waits for
    them. If the caller holds the lock, they would wait for ever. Guests do not wait for each other
    either: a thread that waits for a kernel runs other tasks of the pool, such as loading a
    bitmap, and OpenEXR waits for threads of the same pool. So guests trace, which several threads
    may do at the same time, and replay nothing, see `record`.
    """
    _guests.here = getattr(_guests, "here", 0) + 1
    try:
        yield
    finally:
        _guests.here -= 1


def _is_guest() -> bool:
    return getattr(_guests, "here", 0) > 0


MANY_RECORDINGS = 1 << 30
"""Number of recordings of one program after which Dr.Jit warns; its default is 10. Lists grow and
shrink during a descent, and images have many sizes; each new size is recorded in 3 ms."""


@contextmanager
def freeze_program(function: Program) -> Iterator[Program]:
    """Freeze a function with `drjit.freeze` during a block, and free its program after the block.

    While Dr.Jit 1.5 records a program, the process crashes if Python frees another program or an
    array that shares NumPy's memory. The garbage collector may free such objects at any time if
    they belong to a reference cycle. Therefore the collector is off during calls, and the block
    frees the program.

    A generator that is not exhausted closes its block wherever Python drops it, perhaps in another
    thread or during a recording. Therefore the end of the block only retires the program. It is
    freed at once if no program is running, otherwise by the next `exclusive` block.

    Parameters
    ----------
    function : callable
        Its positional arguments and its result are Dr.Jit arrays, numbers, strings and None, in
        lists, tuples, dictionaries and dataclasses. It changes none of them in place.

    Yields
    ------
    callable
        The frozen function, with the arguments and the result of `function`. Its calls are
        `exclusive`.
    """
    programs, call = _freeze(function)
    try:
        yield call
    finally:
        _retire(programs.clear)


KEPT_RECORDINGS = 8
"""Number of recordings that `record` keeps for a function: the most recently used ones."""

LARGEST_RECORDED = 1 << 22
"""Size of the largest array of a call that is recorded. A replay frees its temporary arrays only at
its end, which takes memory, and for larger arrays the time of tracing is negligible."""


def record(function: Program) -> Program:
    """Freeze a top-level function for all its calls in the process; see `freeze_program`.

    Later fits with arrays of the same sizes replay what the first one recorded. All inputs must be
    positional arguments, because a replay notices nothing else. The function must not sort: on
    cuda, Dr.Jit 1.5 crashes when it records `drjit.argsort`.
    """
    programs, replay = _freeze(lambda sizes, arguments: function(*arguments), KEPT_RECORDINGS)
    atexit.register(programs.clear)

    @wraps(function)
    def call(*arguments: object) -> object:
        arrays: list[DrJitArray] = []
        _flatten(arguments, arrays)
        sizes = [dr.width(array) for array in arrays]  # they may be numbers in a program
        if max(sizes) > LARGEST_RECORDED or _is_guest():
            return function(*arguments)
        result = replay(sizes, arguments)
        # A recording begins a new scope, a replay does not. Later programs order their
        # instructions by scope: they would differ after a replay.
        new_scope(dr.backend_v(arrays[0]))
        return result

    return call


def _freeze(function: Program, limit: int | None = None) -> tuple[dict, Program]:
    """Freeze a function by `drjit.freeze`, once for each shape of its arguments.

    Parameters
    ----------
    function : callable
    limit : int, optional
        Largest number of programs; the least recently used one is dropped first.

    Returns
    -------
    programs : dict
        Its ``clear`` frees what was recorded.
    call : callable
        Takes the arguments of `function`; `exclusive`, with the collector off.
    """
    programs: dict[Shape, tuple[Program, list[Shape]]] = {}  # the last one used comes last
    flushes = 0

    def freeze(shape: Shape) -> tuple[Program, list[Shape]]:
        result: list[Shape] = []

        def trace(flat: list[DrJitArray]) -> list[DrJitArray]:
            arrays: list[DrJitArray] = []
            result[:] = [_flatten(function(*_build(shape, iter(flat))), arrays)]
            return arrays

        # Dr.Jit also traverses the closure of a frozen function: this one only holds `trace`.
        return dr.freeze(lambda flat: trace(flat), warn_after=MANY_RECORDINGS), result

    @wraps(function)
    def call(*arguments: object) -> object:
        nonlocal flushes
        arrays: list[DrJitArray] = []
        shape = _flatten(arguments, arrays)
        with _calling(arrays[0]):
            if flushes != _flushes:
                programs.clear()
                flushes = _flushes
            programs[shape] = programs.pop(shape) if shape in programs else freeze(shape)
            if limit is not None and len(programs) > limit:
                _retire([programs.pop(next(iter(programs)))].clear)
            program, result = programs[shape]
            flat = program(arrays)
            return _build(result[0], iter(flat))

    return programs, call


@contextmanager
def _calling(array: DrJitArray) -> Iterator[None]:
    """Let no other thread use Dr.Jit, and nothing be freed, while a frozen program is called."""
    global _calls
    with exclusive(), collector_off():
        if not _is_recording():
            _count_flushes(array)
        _calls += 1
        try:
            yield
        finally:
            _calls -= 1


def _count_flushes(array: DrJitArray) -> None:
    """Notice that `drjit.flush_kernel_cache` was called: programs from before must not be replayed.

    Dr.Jit 1.5 records a program anew if one of its kernels is gone. But it takes a kernel that was
    compiled again since for the freed one, and then the replay ends the process. So there is danger
    only after kernels were compiled, and then a launch of a kernel that nothing else has tells
    whether that was gone, too.

    Parameters
    ----------
    array : Dr.Jit array
        It gives the backend.
    """
    global _flushes, _misses
    if (before := kernel_misses()) != _misses:
        dr.eval(dr.opaque(dr.uint32_array_t(dr.leaf_t(array)), 1) ^ OUR_KERNEL)
        _misses = kernel_misses()
        _flushes += _misses != before


def freeze_rendering(function: Program) -> Program:
    """Freeze a function that takes objects of Mitsuba, such as a scene, beside arrays.

    Dr.Jit walks what the objects hold at every call, so a change of the scene is noticed. If one of
    them is written in Python, a thread that drops arrays or scenes meanwhile may wait for ever, see
    above, and an array of NumPy that is freed meanwhile ends the process. So once a second thread
    has taken the lock, the function is called as it is.

    Parameters
    ----------
    function : callable
        Of positional arguments, among them an array; it uses nothing else that changes.

    Returns
    -------
    callable
        Its recordings are freed after it.
    """
    frozen = dr.freeze(function, warn_after=MANY_RECORDINGS)
    flushes = 0

    @wraps(function)
    def call(*arguments: object) -> object:
        nonlocal flushes
        with _calling(next(filter(dr.is_array_v, arguments))):
            if len(_users) > 1:
                return function(*arguments)
            if flushes != _flushes:
                frozen.clear()
                flushes = _flushes
            return frozen(*arguments)

    weakref.finalize(call, _retired.append, frozen.clear)  # perhaps during a recording
    return call


def _flatten(value: Any, arrays: list[DrJitArray]) -> Shape:
    """Append the arrays of a value to a list, and return the rest: its shape.

    Raises
    ------
    TypeError
        If the value holds anything other than arrays and constants.
    """
    if dr.is_array_v(value):
        arrays.append(value)
        return None
    kind = type(value)
    if value is None or isinstance(value, str) or kind in CONSTANTS:
        return kind, value
    if is_dataclass(kind):
        names: tuple = _field_names(kind)
        parts = [getattr(value, name) for name in names]
    elif kind is dict:
        names, parts = tuple(value), list(value.values())
    elif isinstance(value, (list, tuple)):
        names, parts = (), list(value)
    else:
        raise TypeError(f"a frozen program takes arrays and numbers, not {kind.__name__}")
    return kind, names, tuple(_flatten(part, arrays) for part in parts)


@cache  # asked at every call of a frozen program
def _field_names(kind: type) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind))


def _build(shape: Shape, arrays: Iterator[DrJitArray]) -> Any:
    """Rebuild a value from its shape and its arrays; the inverse of `_flatten`."""
    if shape is None:
        return next(arrays)
    if len(shape) == 2:
        return shape[1]
    kind, names, parts = shape
    values = [_build(part, arrays) for part in parts]
    if kind is dict:
        return dict(zip(names, values, strict=True))
    if names:
        return kind(**dict(zip(names, values, strict=True)))
    return kind(*values) if hasattr(kind, "_fields") else kind(values)


@contextmanager
def release_later(*objects: object) -> Iterator[None]:
    """Keep objects during a block, and release them after it as `freeze_program` does.

    For a generator that holds arrays of its caller, because they may share NumPy's memory.

    Parameters
    ----------
    *objects
        For example a set of Gaussians.
    """
    kept = list(objects)
    try:
        yield
    finally:
        _retire(kept.clear)


def _retire(release: Callable[[], None]) -> None:
    """Call a function that frees objects, at once or as soon as no program is running."""
    _retired.append(release)
    if _LOCK.acquire(blocking=False):
        try:
            _clear_retired()
        finally:
            _LOCK.release()


def _clear_retired() -> None:
    """Free retired objects, unless a program is running or a user's function is being recorded."""
    while _retired and not _is_recording():
        _retired.popleft()()


def _is_recording() -> bool:
    # A rendering that is traced is a recording, too.
    scopes = dr.JitFlag.FreezingScope, dr.JitFlag.SymbolicScope
    return _calls > 0 or any(map(dr.flag, scopes))


@contextmanager
def collector_off() -> Iterator[None]:
    """Disable Python's garbage collector during a block or a call, until the last thread leaves.

    Texture lookups need it too, because Mitsuba calls them while it records a program. If the
    collector frees another scene during the recording, the program loses the textures of that
    scene, and then crashes the process or reads freed memory.

    Returns
    -------
    context manager
        Also a decorator, ``@collector_off()``.
    """
    global _pauses, _collects
    with _COLLECTOR_LOCK:
        if _pauses == 0:
            _collects = gc.isenabled()
            gc.disable()
        _pauses += 1
    try:
        yield
    finally:
        with _COLLECTOR_LOCK:
            _pauses -= 1
            if _pauses == 0 and _collects:
                gc.enable()
