"""Colours of ``gaussian_texture``: values of its channels, and their spectra.

Channels are decoded and clamped. Reflectance spectra are linear in linear sRGB, hence exactly
differentiable.

Mitsuba's own upsampling (Jakob and Hanika, 2019) looks up its coefficients in a table on the host,
once per texel, so gradients do not reach the colours. Here a spectrum is a weighted sum of three
fixed basis spectra,

    s(l) = r R(l) + g G(l) + b B(l),    R, G, B >= 0,    R + G + B = 1.

Colours in [0, 1] give reflectances in [0, 1], and greys give constant spectra. The idea is from
I. Mallett and C. Yuksel, "Spectral Primary Decomposition for Rendering with sRGB Reflectance",
EGSR 2019. The basis is computed from Mitsuba's own curves, so Mitsuba's integration of a spectrum
returns the colour.
"""

from __future__ import annotations

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from eigengs_dr.backend.arrays import upload
from eigengs_dr.backend.types import Float, Texture

STEP = 5.0
"""Distance of the samples in nm, as in Mitsuba's tables of D65 and the matching functions. Products
with these tables are then cubic polynomials between the samples."""

PENALTY = 1e3
"""Weight of the equality constraints; the differences of neighbouring samples are at most 1."""


@cache  # a quadratic program, for every texture of a spectral variant
def basis() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute the smoothest basis spectra that reproduce the three primaries.

    With the samples x_i of R, G and B in one vector, and the colours M of hat functions,

        minimise    sum (x_{i+1} - x_i)^2
        subject to  M [R G B] = diag(M 1),    R + G + B = 1,    R, G, B >= 0.

    M 1 is the colour of a white surface. It differs from (1, 1, 1) by 2e-4 at most, because Mitsuba
    rounds its constants. First differences, unlike second ones, keep the spectra constant at
    wavelengths that the eye does not see. The equations are rows of large weight in Lawson and
    Hanson's non-negative least squares, which takes some 10 ms.

    Returns
    -------
    wavelengths : ndarray of float64, shape (n,)
        Wavelengths of the samples in nm: 360, 365, ... 830. Between samples, spectra are linear.
    spectra : ndarray of float64, shape (3, n)
        R, G and B. Both arrays are read-only, because callers share them.
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
    """Return the wavelengths (n,), and the linear sRGB (3, n) of hat functions under D65.

    Simpson's rule is exact: a hat, D65 and a matching function are linear between samples.
    """
    # The scalar variant is the fastest for single values and needs no device. It works whatever
    # the current variant is.
    scalar = mi.scalar_rgb
    half = np.arange(scalar.MI_CIE_MIN, scalar.MI_CIE_MAX + 1e-3, STEP / 2)
    light = np.array([np.array(scalar.cie1931_xyz(x)) * scalar.cie_d65(x) for x in half]).T
    to_srgb = np.array([np.array(scalar.xyz_to_srgb(scalar.Color3f(*row))) for row in np.eye(3)]).T
    density = to_srgb @ light * (scalar.MI_CIE_Y_NORMALIZATION * STEP / 3)
    colors = density[:, ::2].copy()
    colors[:, [0, -1]] /= 2
    colors[:, 1:] += density[:, 1::2]
    colors[:, :-1] += density[:, 1::2]
    return half[::2], colors


@cache  # of constants
def mean_weights() -> tuple[float, float, float]:
    """Return the means of R, G and B over the wavelengths, exactly: they are linear in pieces."""
    _, spectra = basis()
    inner = spectra.sum(axis=1) - 0.5 * (spectra[:, 0] + spectra[:, -1])
    red, green, blue = (inner / (spectra.shape[1] - 1)).tolist()
    return red, green, blue


def upload_table() -> Float:
    """Upload the basis for `upsample`, in the current variant (LLVM or CUDA).

    Returns
    -------
    mitsuba.Float
        Four numbers for each interval between samples: R and G at its start, and their increments.
        One packet gather then reads all numbers for a wavelength, since B = 1 - R - G.
    """
    red_green = basis()[1][:2]
    intervals = np.concatenate([red_green[:, :-1], np.diff(red_green, axis=1)])
    return upload(mi.Float, intervals.T.astype(np.float32).ravel())


def upsample(rgb: mi.Color3f, wavelengths: mi.Spectrum, table: Float) -> mi.Spectrum:
    """Return the reflectance spectrum of a colour, s = b + (r - b) R + (g - b) G.

    This form keeps greys exactly grey in floating point. The function evaluates nothing, so
    symbolic loops and calls may contain it. Gradients flow to the colour, in both AD modes.

    Parameters
    ----------
    rgb : mitsuba.Color3f
        Linear sRGB: in [0, 1] for a reflectance, but any value works.
    wavelengths : mitsuba.Spectrum
        Wavelengths in nm, such as ``si.wavelengths``.
    table : mitsuba.Float
        Result of `upload_table`.

    Returns
    -------
    mitsuba.Spectrum, of the type of `wavelengths`
        The reflectance; 0 for wavelengths that are NaN or outside of 360 to 830 nm.
    """
    result = []
    for wavelength in wavelengths:
        inside = (wavelength >= mi.MI_CIE_MIN) & (wavelength <= mi.MI_CIE_MAX)
        # NaN must not become an index: no mask would keep the gather inside the table.
        position = (dr.select(inside, wavelength, mi.MI_CIE_MIN) - mi.MI_CIE_MIN) / STEP
        start = dr.minimum(mi.UInt32(position), dr.width(table) // 4 - 1)
        value = dr.gather(mi.Vector4f, table, start)
        fraction = position - mi.Float(start)
        red = dr.fma(fraction, value[2], value[0])
        green = dr.fma(fraction, value[3], value[1])
        spectrum = dr.fma(rgb[0] - rgb[2], red, dr.fma(rgb[1] - rgb[2], green, rgb[2]))
        result.append(dr.select(inside, spectrum, 0))
    return type(wavelengths)(result)


def shown_channels(texture: Texture, values: list) -> list:
    """Clamp and decode all channels, unless raw, see `eigengs_dr.image.space.Space.to_lights`.

    Two channels are the codes of x and y of normals, whose z follows from the length 1.
    """
    channels = values if texture.raw else texture.space.to_lights(values)
    return _with_z(channels) if len(channels) == 2 else channels


def _with_z(codes: list) -> list:
    """Add the code of z = sqrt(1 - x^2 - y^2), whose derivative is bounded."""
    x, y = (2 * code - 1 for code in codes)
    square = dr.fma(-x, x, dr.fma(-y, y, 1))
    return [*codes, dr.fma(0.5, dr.sqrt(dr.maximum(square, FLATTEST)), 0.5)]


FLATTEST = 1e-4
"""Smallest square of z: with the slope 1/2z, codes of x and y count up to a hundredfold there."""


def slope_of(texture: Texture, value: Float) -> Float:
    """Return the derivative of `shown_channels` for a channel, but 0 where it clamps."""
    if texture.raw:
        return type(value)(1)
    within = (value >= 0) & (value <= texture.space.largest)
    return dr.select(within, type(value)(texture.space.slope(value)), 0)


def unpolarized(light: mi.UnpolarizedSpectrum) -> mi.Spectrum:
    """Return unpolarized light as the spectrum of the variant."""
    return mi.depolarizer(light) if mi.is_polarized else light


def luminance(color: list) -> Float:
    """Return the luminance of three channels, or the single channel."""
    return color[0] if len(color) == 1 else mi.luminance(mi.Color3f(*color))


def brightness(texture: Texture, color: list) -> Float:
    """Return the mean that the texture reflects or emits: over wavelengths, where it has spectra.

    Parameters
    ----------
    texture : mitsuba.Texture
    color : list of Float
        Channels from `shown_channels`.

    Returns
    -------
    Float
        In spectral variants the mean of the spectrum of `upsample`, as of a ``bitmap``; else the
        luminance.
    """
    if mi.is_spectral and len(color) == 3 and not texture.raw and texture.space.is_color:
        return sum(w * c for w, c in zip(mean_weights(), color, strict=True))
    return luminance(color)


def keep_finite(x: Float) -> Float:
    """Replace values that are not finite, which an optimiser may leave, by 0."""
    return dr.select(dr.isfinite(x), x, 0)
