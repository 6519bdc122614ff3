"""The command ``eigengs-dr pack`` for a material."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..fitting.options import Levels
from .fit_material import MapFile, by_name, load_map

if TYPE_CHECKING:
    from ..codec.packing import MaterialPackResult, PackResult
    from ..gaussian.gaussians import Gaussians


def pack_maps(
    file: Path,
    target: Path,
    image: Path | None,
    maps: tuple[MapFile, ...],
    encoding: str | None,
    max_psnr_drop: float,
    levels: Levels,
    backend: str | None,
    quiet: bool,
) -> dict[str, Any]:
    """Pack a material, and return its figures."""
    import eigengs_dr as eg

    if image:
        raise ValueError(f"{file}: holds a material; give its images by --map NAME=FILE")
    if levels != 1:
        raise ValueError(f"{file}: a material has no levels in .egs files; leave --levels out")
    material = eg.Material.load(file, backend)
    spaces = {m.name: m.space for m in material.maps}
    named = {
        name: item._replace(space=item.space or spaces.get(name))
        for name, item in by_name(maps).items()
    }
    images = {name: load_map(item, encoding) for name, item in named.items()} or None
    try:
        packed = eg.pack_material(material, target, images, max_psnr_drop, encoding)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    before = file.stat().st_size
    if not quiet:
        shown = ", ".join(f"{name} {psnr:.2f} dB" for name, psnr in packed.psnr.items())
        against = "the images" if images else "the renderings of the input"
        click.echo(
            f"{file}: {len(material.gaussians):,} Gaussians, {before:,} bytes\n"
            f"  wrote {target}: {packed.bytes:,} bytes, "
            f"{packed.bits_per_pixel:.3f} bits per pixel for all maps\n"
            f"  lost {packed.psnr_drop:.2f} dB; psnr_rgb against {against}: {shown}"
        )
    return packing_figures(file, target, material.gaussians, max_psnr_drop, packed, "psnr_rgb")


def packing_figures(
    file: Path,
    target: Path,
    gaussians: Gaussians,
    max_psnr_drop: float,
    packed: PackResult | MaterialPackResult,
    psnr: str,
) -> dict[str, Any]:
    """Return the figures of a report, with the PSNR under a key of its kind."""
    return {
        "input": str(file),
        "output": str(target),
        "gaussians": len(gaussians),
        "max_psnr_drop": max_psnr_drop,
        "bytes_before": file.stat().st_size,
        "bytes": packed.bytes,
        "bits_per_pixel": packed.bits_per_pixel,
        psnr: packed.psnr,
        "lost": packed.psnr_drop,
        "steps": packed.steps._asdict(),
    }
