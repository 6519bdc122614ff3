"""The table of a model of lights in a packed file.

A factor is an integer times the step of its plane. The fainter a plane, the larger its step, so
that each adds the same squared error to the photos. The integers of a light are coded as their
differences from those of the nearest light before, and a colour as its difference from the one
before; both are small. The rest follows Student's distribution, with one width for the first colour
of a plane and one for the others.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from ..backend.types import Doubles, Integers
from ..codec.exact_math import exp2
from ..codec.range_coder import CLASSES_PER_OCTAVE, MIN_CLASS, Coder, Decoder, Encoder
from ..storage.npz import BadValue
from .lights import KINDS, MAX_FACTOR, MAX_LIGHTS, LightTable, check_table

_HEAD = struct.Struct("<BBHfdf")
"""Kind, planes, lights, smoothing, the PSNR of left-out lights, and the largest code of photos."""

STEPS_PER_OCTAVE = 4
"""Number of possible steps per octave."""

TAILS = 8
"""Degrees of freedom of Student's distribution, see `eigengs_dr.codec.range_coder.TAILS`."""

TINY = 1e-12
"""Smallest mean square that counts: a plane or a difference may be 0."""


def table_bytes(
    table: LightTable, squares: Doubles, error: float, psnr_held_out: float, brightest: float
) -> bytes:
    """Return the table of a model for an ``.egs`` file.

    Its head (`_HEAD`) precedes x and y of the lights, (n, 2) int16 over 32767; the binary logarithm
    of the steps in quarters, (K + 1,) int8, last of what is added to all pixels; that of the widths
    in thirds, (2, K + 1) int8; and the words of a range coder: the differences, (n, 3, K + 1).

    Parameters
    ----------
    table : LightTable
    squares : ndarray of float64, shape (K,)
        Mean square of each plane.
    error : float
        Mean squared error of the photos that rounding may add.
    psnr_held_out, brightest : float
        Those of the model.
    """
    planes = len(squares)
    allowed = 12 * error / (planes + 1) / np.append(np.maximum(squares, TINY), 1)
    logarithms = STEPS_PER_OCTAVE / 2 * np.log2(np.maximum(allowed, TINY**2))
    octaves = np.floor(logarithms).clip(-128, 127).astype(np.int8)
    lights = np.round(table.lights[:, :2] * 32767).astype("<i2")
    integers = np.rint(table.values / _steps(octaves)).astype(np.int64)
    of_colors = np.diff(integers, axis=1, prepend=0)
    differences = of_colors.copy()
    differences[1:] -= of_colors[_nearest_before(lights)]
    squared = np.square(differences, dtype=np.float64)
    mean_squares = np.stack([squared[:, 0].mean(axis=0), squared[:, 1:].mean(axis=(0, 1))])
    logarithms = CLASSES_PER_OCTAVE / 2 * np.log2(np.maximum(mean_squares, TINY))
    widths = np.rint(logarithms.clip(MIN_CLASS, 127)).astype(np.int8)
    coder = Encoder()
    _code(coder, widths, differences)
    head = _HEAD.pack(
        KINDS.index(table.kind),
        planes,
        len(lights),
        table.smoothing,
        psnr_held_out,
        brightest,
    )
    return b"".join([head, *(a.tobytes() for a in (lights, octaves, widths)), coder.to_bytes()])


def read_table(content: bytes, channels: int) -> tuple[LightTable, float, float]:
    """Return what `table_bytes` wrote: the table, the PSNR and the largest code of photos."""
    if len(content) < _HEAD.size:
        raise BadValue("the table of lights is truncated; copy the file again")
    kind, planes, count, smoothing, psnr, brightest = _HEAD.unpack_from(content)
    ends = (_HEAD.size + np.cumsum([0, 4 * count, planes + 1, 2 * (planes + 1)])).tolist()
    if planes != channels or not 1 <= count <= MAX_LIGHTS or ends[-1] > len(content):
        raise BadValue("the table of lights has another size; copy the file again")
    lights = np.frombuffer(content[: ends[1]], "<i2", offset=ends[0]).reshape(count, 2)
    octaves = np.frombuffer(content[: ends[2]], np.int8, offset=ends[1])
    widths = np.frombuffer(content[: ends[3]], np.int8, offset=ends[2]).reshape(2, -1)
    differences = np.zeros((count, 3, planes + 1), np.int64)
    differences = _code(Decoder(content[ends[-1] :]), widths, differences)
    for light, before in enumerate(_nearest_before(lights), 1):
        differences[light] += differences[before]
    values = differences.cumsum(axis=1) * _steps(octaves)
    x, y = lights.T / 32767
    directions = np.stack([x, y, np.sqrt(np.maximum(1 - x * x - y * y, 0))], axis=1)
    name = KINDS[kind] if kind < len(KINDS) else f"number {kind}"
    table = check_table(LightTable(directions, values, name, smoothing), planes)
    return table, psnr, check_brightest(brightest)


def check_brightest(code: float) -> float:
    """Return the largest code of photos; raise `BadValue` if it is none."""
    if not 1 <= code <= MAX_FACTOR:
        raise BadValue(f"brightest is {code}, expected 1 to {MAX_FACTOR:g}")
    return code


def _steps(octaves: NDArray[np.int8]) -> Doubles:
    return np.exp2(octaves / STEPS_PER_OCTAVE)


def _nearest_before(lights: NDArray[np.int16]) -> list[int]:
    """Return for each light but the first which of those before it is nearest, by x and y."""
    points = lights.astype(np.int64)  # integers: a reader must find the same
    squares = (np.square(points[:k] - points[k]).sum(axis=1) for k in range(1, len(points)))
    return [int(np.argmin(square)) for square in squares]


def _code(coder: Coder, widths: NDArray[np.int8], differences: Integers) -> Integers:
    """Code differences (n, 3, K + 1) with widths (2, K + 1)."""
    classes = np.broadcast_to(widths[[0, 1, 1]] / CLASSES_PER_OCTAVE, differences.shape)
    centres = np.zeros(differences.size)
    coded = coder.numbers(centres, exp2(classes.ravel()), TAILS, differences.ravel())
    return coded.reshape(differences.shape)
