"""Reflectance spectra from linear sRGB: linear in the colour, hence exactly differentiable.

Mitsuba's own upsampling (Jakob and Hanika, 2019) looks up its coefficients in a table on the host,
once a texel, so that no derivative leads back to the colours. Here instead a spectrum is a weighted
sum of three fixed basis spectra,

    s(l) = r R(l) + g G(l) + b B(l),    R, G, B >= 0,    R + G + B = 1,

so that colours in [0, 1] give reflectances in [0, 1], and greys give constant spectra. The idea is
that of I. Mallett and C. Yuksel, "Spectral Primary Decomposition for Rendering with sRGB
Reflectance", EGSR 2019; the basis is computed from Mitsuba's own curves, so that it is Mitsuba
that gets back the colours.
"""

from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from eigengs_dr.backend.arrays import upload

STEP = 5.0
"""Distance of the samples, in nm. That of Mitsuba's tables of D65 and the matching functions, so
that products with them are cubic polynomials between the samples."""

PENALTY = 1e3
"""Weight of the equality constraints, against differences of neighbouring samples of at most 1."""


@cache
def basis() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute the basis spectra: the smoothest that give back the three primaries.

    With the samples x_i of R, G and B side by side, and M the colours of hat functions,

        minimise    sum (x_{i+1} - x_i)^2
        subject to  M [R G B] = diag(M 1),    R + G + B = 1,    R, G, B >= 0.

    M 1 is the colour of a white surface, which misses (1, 1, 1) by 2e-4 at most, as Mitsuba rounds
    its constants. First differences, unlike second ones, leave the spectra constant where the eye
    sees nothing. The equations enter as rows of large weight, so that Lawson and Hanson's
    non-negative least squares solves the problem, in some 10 ms.

    Returns
    -------
    wavelengths : ndarray of float64, shape (n,)
        Where the spectra are sampled, in nm: 360, 365, ... 830. In between they are linear.
    spectra : ndarray of float64, shape (3, n)
        R, G and B. Callers share both arrays, so that neither can be written to.
    """
    wavelengths, colors = _hat_colors()
    count = len(wavelengths)
    smooth = np.kron(np.eye(3), np.diff(np.eye(count), axis=0))
    primaries = np.kron(np.eye(3), colors)
    unity = np.kron(np.ones((1, 3)), np.eye(count))
    solution, _ = nnls(
        np.vstack([smooth, PENALTY * primaries, PENALTY * unity]),
        np.concatenate(
            [
                np.zeros(len(smooth)),
                PENALTY * np.diag(colors.sum(axis=1)).ravel(),
                np.full(count, PENALTY),
            ]
        ),
        maxiter=100 * count,
    )
    spectra = solution.reshape(3, count)
    spectra /= spectra.sum(axis=0)  # the penalty leaves 1e-7
    wavelengths.flags.writeable = spectra.flags.writeable = False
    return wavelengths, spectra


def _hat_colors() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Integrate hat functions under D65: samples, shape (n,), and linear sRGB, shape (3, n).

    A hat, D65 and a matching function are each linear between samples: Simpson's rule is exact.
    """
    # Any variant has these functions; this one is quickest for single values, needs no device and
    # need not be the one that is set.
    scalar: Any = mi.scalar_rgb
    half = np.arange(scalar.MI_CIE_MIN, scalar.MI_CIE_MAX + 1e-3, STEP / 2)
    light = np.array([np.array(scalar.cie1931_xyz(x)) * scalar.cie_d65(x) for x in half]).T
    to_srgb = np.array([np.array(scalar.xyz_to_srgb(scalar.Color3f(*row))) for row in np.eye(3)]).T
    density = to_srgb @ light * (scalar.MI_CIE_Y_NORMALIZATION * STEP / 3)
    colors = density[:, ::2].copy()
    colors[:, [0, -1]] /= 2
    colors[:, 1:] += density[:, 1::2]
    colors[:, :-1] += density[:, 1::2]
    return half[::2], colors


def upload_table() -> Any:
    """Upload the basis for `upsample`, in the variant that is set (LLVM or CUDA).

    Returns
    -------
    mitsuba.Float
        Four numbers for each interval between samples: R and G at its start, and their increments.
        One packet gather then reads all that a wavelength needs; B is what is missing to 1.
    """
    red_green = basis()[1][:2]
    intervals = np.concatenate([red_green[:, :-1], np.diff(red_green, axis=1)])
    return upload(mi.Float, intervals.T.astype(np.float32).ravel())


def upsample(rgb: Any, wavelengths: Any, table: Any) -> Any:
    """Evaluate the reflectance spectrum of a colour, s = b + (r - b) R + (g - b) G.

    So written, greys are exactly grey in floating point too. Nothing is evaluated: the function
    may be called inside symbolic loops and calls. Derivatives lead to the colour, in both modes.

    Parameters
    ----------
    rgb : mitsuba.Color3f
        Linear sRGB. In [0, 1] for a reflectance, but any value will do.
    wavelengths : mitsuba.Spectrum
        Wavelengths in nm, such as ``si.wavelengths``.
    table : mitsuba.Float
        What `upload_table` returned.

    Returns
    -------
    mitsuba.Spectrum, of the type of `wavelengths`
        The reflectance; zero outside of 360 to 830 nm, and where a wavelength is not a number.
    """
    result = []
    for wavelength in wavelengths:
        inside = (wavelength >= mi.MI_CIE_MIN) & (wavelength <= mi.MI_CIE_MAX)
        # NaN must not become an index: no mask would then keep the gather inside of the table.
        position = (dr.select(inside, wavelength, mi.MI_CIE_MIN) - mi.MI_CIE_MIN) / STEP
        start = dr.minimum(mi.UInt32(position), dr.width(table) // 4 - 1)
        value = dr.gather(mi.Vector4f, table, start)
        fraction = position - mi.Float(start)
        red = dr.fma(fraction, value[2], value[0])
        green = dr.fma(fraction, value[3], value[1])
        spectrum = dr.fma(rgb[0] - rgb[2], red, dr.fma(rgb[1] - rgb[2], green, rgb[2]))
        result.append(dr.select(inside, spectrum, 0))
    return type(wavelengths)(result)
