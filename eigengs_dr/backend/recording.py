"""Programs of Dr.Jit: one thread at a time; frozen ones are freed at a safe moment.

Dr.Jit 1.5 keeps state for the whole process. While one thread records or replays a frozen program,
another thread that traces, differentiates, records or frees a program ends the process, hangs it,
or lets the replay fail ("determining size of variable"). One lock of this module excludes that.
"""

from __future__ import annotations

import atexit
import gc
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass
from functools import wraps
from typing import Any

import drjit as dr

from .detail import new_scope

Program = Callable[..., Any]
"""A function of Dr.Jit arrays."""

_LOCK = threading.RLock()
"""The thread that holds it may use Dr.Jit."""

_retired: deque[Callable[[], None]] = deque()
"""Functions that free programs and arrays that nobody uses any more; for `_clear_retired`."""

_calls = 0
"""Calls of frozen programs under way, in the thread that holds `_LOCK`."""

_COLLECTOR_LOCK = threading.RLock()
_pauses = 0
"""Blocks that keep the garbage collector off, in all threads."""
_collects = False
"""Whether the collector was on before the first of these blocks."""


@contextmanager
def exclusive() -> Iterator[None]:
    """Let no other thread use Dr.Jit during a block, or during every call of a function.

    The functions of this package that use Dr.Jit do so by themselves, as `eigengs_dr.fit` and
    `eigengs_dr.render`. Use it around your own use of Dr.Jit or Mitsuba, such as `drjit.backward`
    or `mitsuba.render`, if another thread may call this package meanwhile. Blocks of one thread
    may nest. Scenes may be loaded in a block: Mitsuba's loading threads are let in. A block that
    waits for any other thread must not hold what that thread waits for.

    Returns
    -------
    context manager
        Also a decorator, ``@exclusive()``, of functions that are no generators.

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
    with _LOCK:
        _clear_retired()
        try:
            yield
        finally:
            _clear_retired()


_guests = threading.local()
"""``here`` counts the blocks of `guest` around this thread, which works for one that waits."""


@contextmanager
def guest() -> Iterator[None]:
    """Use Dr.Jit for a thread that waits for this one: nothing in the block waits for a lock.

    Mitsuba makes the objects of a scene in the threads of Dr.Jit's pool, for which the caller
    waits. If the caller holds the lock, they would wait for it for ever. Guests do not even wait
    for each other: a thread that waits for a kernel does other work of the pool meanwhile, such as
    the object of a bitmap, and OpenEXR waits for threads of the same pool. So guests trace, which
    threads may do at once, and replay nothing, see `record`.
    """
    _guests.here = getattr(_guests, "here", 0) + 1
    try:
        yield
    finally:
        _guests.here -= 1


def _is_guest() -> bool:
    return getattr(_guests, "here", 0) > 0


MANY_RECORDINGS = 1 << 30
"""Recordings of one program after which Dr.Jit warns; by default after 10. Lists grow and shrink in
a descent, and images have many sizes: each other size is recorded, in 3 ms, which is no fault."""


@contextmanager
def freeze_program(function: Program) -> Iterator[Program]:
    """Freeze a function with `drjit.freeze` during a block, and free its program after the block.

    While Dr.Jit 1.5 records a program, the process ends if Python frees another program or an array
    that shares NumPy's memory. The garbage collector frees such objects at any time if a reference
    cycle holds them. Therefore the collector is off during calls, and the block frees the program.

    A generator that nobody reads to its end closes its block wherever Python drops it, perhaps in
    another thread or during a recording. Therefore the end of the block only retires the program.
    It is freed at once if no program is being called, else by the next `exclusive` block.

    Parameters
    ----------
    function : callable
        A function that `drjit.freeze` accepts.

    Yields
    ------
    callable
        The frozen function, with the arguments and the result of `function`. Its calls are
        `exclusive`.
    """
    program = dr.freeze(function, warn_after=MANY_RECORDINGS)
    try:
        yield _guarded(program, function)
    finally:
        _retire(program.clear)


KEPT_RECORDINGS = 8
"""Recordings that a program of `record` keeps: those that were used last."""

LARGEST_RECORDED = 1 << 22
"""Size of the largest array of a call that is recorded. A replay frees its temporary arrays at its
end, which takes memory, and where arrays are larger tracing hardly counts."""


def record(function: Program) -> Program:
    """Freeze a function of a module, for all its calls in the process; see `freeze_program`.

    Other fits with arrays of the same sizes replay what the first one recorded. All that a call
    needs must be in its arguments, and these must be positional: a replay notices nothing else.
    The function may not sort: on cuda, Dr.Jit 1.5 ends the process when it records `drjit.argsort`.
    """
    program = dr.freeze(
        lambda sizes, *arguments: function(*arguments),
        limit=KEPT_RECORDINGS,
        warn_after=MANY_RECORDINGS,
    )
    atexit.register(program.clear)
    replay = _guarded(program, function)

    @wraps(function)
    def call(*arguments: Any) -> Any:
        arrays = list(_arrays_in(arguments))
        sizes = [dr.width(array) for array in arrays]  # they may be numbers in a program
        if max(sizes) > LARGEST_RECORDED or _is_guest():
            return function(*arguments)
        found = replay(sizes, *arguments)
        # A recording begins a new scope, a replay does not. Programs of later operations have
        # their instructions in the order of scopes: they would be others after a replay.
        new_scope(dr.backend_v(arrays[0]))
        return found

    return call


def _arrays_in(arguments: Iterable[Any]) -> Iterator[Any]:
    """Yield all arrays in some arguments."""
    for value in arguments:
        if dr.is_array_v(value):
            yield value
        elif isinstance(value, (list, tuple)):
            yield from _arrays_in(value)
        elif is_dataclass(value):
            yield from _arrays_in(vars(value).values())


def _guarded(program: Program, function: Program) -> Program:
    """Return a frozen function whose calls are `exclusive`, with the collector off."""

    @wraps(function)
    def call(*arguments: Any, **settings: Any) -> Any:
        global _calls
        with exclusive(), collector_off():
            _calls += 1
            try:
                return program(*arguments, **settings)
            except RuntimeError as error:
                if isinstance(error.__cause__, KeyboardInterrupt):  # Dr.Jit wraps what it meets
                    raise KeyboardInterrupt from error
                raise
            finally:
                _calls -= 1

    return call


@contextmanager
def release_later(*objects: object) -> Iterator[None]:
    """Keep objects during a block, and release them after it as `freeze_program` its program.

    For a generator that holds arrays of its caller, because they may share NumPy's memory.

    Parameters
    ----------
    *objects
        Such as a set of Gaussians.
    """
    kept = list(objects)
    try:
        yield
    finally:
        _retire(kept.clear)


def _retire(release: Callable[[], None]) -> None:
    """Call a function that frees objects, at once or when no program is being called."""
    _retired.append(release)
    if _LOCK.acquire(blocking=False):
        try:
            _clear_retired()
        finally:
            _LOCK.release()


def _clear_retired() -> None:
    """Free what nobody uses any more, unless a program is being called, or a user's is recorded."""
    while _retired and not _calls and not dr.flag(dr.JitFlag.FreezingScope):
        _retired.popleft()()


@contextmanager
def collector_off() -> Iterator[None]:
    """Keep Python's garbage collector off during a block or a call; on after the last thread's.

    Lookups of a texture need it too: Mitsuba calls them while it records a program. If the
    collector frees another scene during the recording, the program loses the textures of that
    scene; it then ends the process or reads freed memory.

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
