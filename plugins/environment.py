"""A set as light from all directions: as Gaussians, or as the bitmap of an ``envmap``."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from eigengs_dr.backend.arrays import types_of, upload
from eigengs_dr.backend.doors import door
from eigengs_dr.backend.types import Record, Tensor
from eigengs_dr.gaussian.gaussians import Fitted, Gaussians
from eigengs_dr.image.color import to_linear
from eigengs_dr.raster.render import render
from eigengs_dr.relight.directions import LatLong

from .parameters import given, plugin_of
from .versions import columns_beyond


@door
def environment_of(gaussians: Gaussians | Fitted, **properties: object) -> Record:
    """Return a set as the dictionary of a ``gaussian_environment``, for `mitsuba.load_dict`.

    Parameters
    ----------
    gaussians : Gaussians or Fit
        A set of light in equirectangular projection: twice as wide as high.
    **properties
        Other properties of the emitter: ``scale``, ``to_world``, ``prefilter``, ``cutoff``,
        ``memory``. None stands for the default.

    Returns
    -------
    dict
        The tensors, size, space and cutoff of the set, and the other properties.

    Examples
    --------
    >>> import eigengs_dr as eg, mitsuba as mi
    >>> from eigengs_dr.plugins import environment_of
    >>> mi.set_variant("llvm_ad_rgb")
    >>> eg.register_plugins()
    >>> sky = eg.Gaussians.from_arrays(
    ...     [[8, 4]], [[0.2, 0, 0.2]], [[9, 9, 8]], size=(16, 8), space="radiance"
    ... )
    >>> scene = mi.load_dict({"type": "scene", "sky": environment_of(sky, scale=0.5)})
    """
    return plugin_of("gaussian_environment", gaussians, **properties)


def texels_of(parameters: mi.SceneParameters, key: str, picture: Tensor) -> Tensor:
    """Return a picture as the texels of a parameter; an ``envmap`` has extra columns.

    Parameters
    ----------
    parameters : mitsuba.SceneParameters
    key : str
        Name of the texels.
    picture : TensorXf, shape (H, W, C)

    Returns
    -------
    TensorXf
        Differentiable. For an ``envmap``, light is clamped at 0, and columns beyond the seam are
        added.
    """
    node = parameters.properties[key][2]
    if not isinstance(node, mi.Emitter):
        return mi.TensorXf(picture)
    height, width, channels = picture.shape
    left, right = columns_beyond()
    column = np.arange(-left, width + right) % width
    texel = (np.arange(height)[:, None] * width + column)[..., None] * channels
    index = upload(mi.UInt32, (texel + np.arange(channels)).astype(np.uint32).ravel())
    light = dr.gather(mi.Float, dr.maximum(picture.array, 0), index)
    return mi.TensorXf(light, (height, width + left + right, channels))


@door
def bake_environment(
    gaussians: Gaussians, width: int | None = None, height: int | None = None, **properties: object
) -> Record:
    """Render a set to the bitmap of an ``envmap``, for `mitsuba.load_dict`.

    Parameters
    ----------
    gaussians : Gaussians
        A set of three channels, in equirectangular projection: twice as wide as high.
    width, height : int, optional
        Size of the bitmap in pixels, as for `eigengs_dr.render`; by default the native size.
    **properties
        Other properties of the emitter: ``scale``, ``to_world``.

    Returns
    -------
    dict
        The emitter with a bitmap of linear light; negative light is 0. Its first and last rows are
        the poles, as an ``envmap`` reads them.

    Raises
    ------
    ValueError
        If the set has other channels, or holds data, or the bitmap has one row.

    Examples
    --------
    >>> import eigengs_dr as eg, mitsuba as mi
    >>> from eigengs_dr.plugins import bake_environment
    >>> mi.set_variant("llvm_ad_rgb")
    >>> sky = eg.Gaussians.from_arrays(
    ...     [[8, 4]], [[0.2, 0, 0.2]], [[9, 9, 8]], size=(16, 8), space="radiance"
    ... )
    >>> scene = mi.load_dict({"type": "scene", "sky": bake_environment(sky)})
    """
    if gaussians.channels != 3 or not gaussians.space.is_color:
        raise ValueError(
            f"bake_environment: the set has {gaussians.channels} channels in the space "
            f"{gaussians.space!r}; it needs three of light or colour"
        )
    if height is None:
        ratio = 1.0 if width is None else width / gaussians.width
        height = round(ratio * gaussians.height)
    picture = render(_from_pole_to_pole(gaussians, height), width, height).numpy()
    light = to_linear(picture) if gaussians.space.encoding == "srgb" else picture
    bitmap = mi.Bitmap(np.maximum(light, 0).astype(np.float32))
    return {"type": "envmap", "bitmap": bitmap, **given(properties)}


def _from_pole_to_pole(gaussians: Gaussians, rows: int) -> Gaussians:
    """Move Gaussians, so that the centres of the outermost of so many rows show the poles.

    They do in the native rows: `eigengs_dr.plugins.gaussian_environment`.
    """
    if min(rows, gaussians.height) < 2:
        raise ValueError(
            f"bake_environment: {min(rows, gaussians.height)} rows; the set and the bitmap must "
            "have at least 2, one for each pole"
        )
    types, native = types_of(gaussians.mean), gaussians.height
    now, then = (LatLong(gaussians.width, n, pole_to_pole=True) for n in (native, rows))
    stretch = then.rows / now.rows * (native / rows)
    ratio, border = (dr.opaque(types.Float, v) for v in (stretch, (native / rows - stretch) / 2))
    (x, y), (a, b, c) = gaussians.mean, gaussians.factor
    return replace(
        gaussians,
        mean=types.Float2(x, dr.fma(y, ratio, border)),
        factor=types.Float3(a, b / ratio, c / ratio),
    )
