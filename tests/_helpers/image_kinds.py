"""A file of every kind that the manual names, and the picture that is due."""

from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import OpenImageIO as oiio
import skimage
import tifffile
from PIL import Image, ImageCms

from _helpers.files import exif, insert_chunk

H, W = 6, 8
RGB = np.random.default_rng(0).integers(0, 256, (H, W, 3), np.uint8)
GREY = RGB[..., :1]
ALPHA = np.random.default_rng(1).integers(1, 256, (H, W, 1), np.uint8)
PALETTE = np.random.default_rng(2).integers(0, 256, (256, 3), np.uint8)
COLORS = PALETTE[GREY[..., 0]] / 255
LEVELS = RGB / 255
OVER_WHITE = 1 - ALPHA / 255 * (1 - LEVELS)
TURNED = np.rot90(LEVELS, -1)
KEY = int(GREY[2, 2, 0])
"""A level that is transparent."""


class Kind(NamedTuple):
    """A kind of file; `write(path)` returns the picture (H, W, 3 or 1), or None if none is due."""

    format: str
    what: str
    suffix: str
    write: object


def write_tiff(path, pixels=RGB, shown=LEVELS, **options):
    pixels = pixels[..., 0] if pixels.shape[-1] == 1 else pixels
    tifffile.imwrite(path, pixels, **options)
    return shown


def write_alpha(path, kind, shown=OVER_WHITE):
    colors = RGB * (ALPHA / 255) if kind == "assocalpha" else RGB
    pixels = np.rint(257.0 * np.concatenate([colors, ALPHA], axis=2)).astype(np.uint16)
    return write_tiff(path, pixels, shown, photometric="rgb", extrasamples=[kind])


def write_openimageio(path, pixels, **attributes):
    image = oiio.ImageBuf(np.ascontiguousarray(pixels))
    image.set_write_format("float" if pixels.dtype.kind == "f" else pixels.dtype.name)
    for name, value in attributes.items():
        image.specmod().attribute(name, value)
    assert image.write(str(path)), image.geterror()
    return LEVELS


def pillow_image(mode):
    """An image of a mode, and its picture."""
    if mode == "L":
        return Image.fromarray(GREY[..., 0]), GREY / 255
    if mode == "1":
        return Image.fromarray(GREY[..., 0] > 127), (GREY > 127) * 1.0
    if mode == "P":
        image = Image.fromarray(GREY[..., 0], "P")
        image.putpalette(PALETTE.tobytes())
        return image, COLORS
    if mode == "RGBA":
        return Image.fromarray(np.concatenate([RGB, ALPHA], 2)), OVER_WHITE
    if mode == "LA":
        image = Image.fromarray(np.concatenate([GREY, ALPHA], 2), "LA")
        return image, 1 - ALPHA / 255 * (1 - GREY / 255)
    return Image.fromarray(RGB).convert(mode), LEVELS


def write_pillow(path, mode="RGB", shown=None, **options):
    image, picture = pillow_image(mode)
    image.save(path, **options)
    return picture if shown is None else shown


def write_key(path, mode="P"):
    """An image of which one level is transparent."""
    shown = write_pillow(path, mode, transparency=KEY)
    return np.where(GREY == KEY, 1, shown)


def write_frames(path, **options):
    others = [Image.new("RGB", (W, H), color) for color in ("red", "lime")]
    image = Image.fromarray(RGB).quantize(64) if path.suffix == ".gif" else Image.fromarray(RGB)
    image.save(path, save_all=True, append_images=others, **options)
    return np.asarray(image.convert("RGB")) / 255


def write_chunk(path, name, data):
    write_pillow(path)
    insert_chunk(path, name, data)
    return LEVELS


def write_netpbm(path, white):
    values = RGB.astype(np.int64) * white // 255
    path.write_bytes(f"P6\n{W} {H}\n{white}\n".encode() + values.astype(">u2").tobytes())
    return values / white


def write_hdr(path, old=b"", new=b"", shown=LEVELS):
    """A Radiance file in which bytes of the header are others."""
    write_openimageio(path, LEVELS.astype(np.float32))
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new, 1))
    return shown


def write_exr(path, shown=LEVELS, origin=(0, 0), window=(W, H), names="RGB", **attributes):
    pixels = np.concatenate([RGB, ALPHA], 2)[..., : len(names)] / 255
    spec = oiio.ImageSpec(W, H, len(names), "float")
    spec.channelnames = tuple(names)
    spec.x, spec.y = origin
    spec.full_x = spec.full_y = 0
    spec.full_width, spec.full_height = window
    for name, value in attributes.items():
        spec.attribute(name, "float[8]", value)
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), spec)
    assert file.write_image(pixels.astype(np.float32)) and file.close()
    return shown


def other_profile():
    """A profile whose colours are not those of sRGB: that of a photo of scikit-image."""
    return Image.open(Path(skimage.__file__).parent / "data/rocket.jpg").info["icc_profile"]


def wider(image):
    """A display window of 12 x 9, of which the image fills a part from (2, 1) on."""
    return np.pad(image, ((1, 2), (2, 2), (0, 0)))


SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
SEPARATE = {"pixels": np.moveaxis(RGB, 2, 0), "photometric": "rgb", "planarconfig": "separate"}
INKS = np.concatenate([255 - RGB, np.full((H, W, 1), 51, np.uint8)], axis=2)
TABLE = np.ascontiguousarray(PALETTE.T.astype(np.uint16) * 257)
FLOATS = {"pixels": GREY.astype(np.float32), "shown": None}
REFUSED = {"shown": None}
PRIMARIES = b"\nPRIMARIES= "
P3 = PRIMARIES + b".68 .32 .265 .69 1.5e-1 .06 .3127 .329\n\n"
ACES = (0.7347, 0.2653, 0, 1, 0.0001, -0.077, 0.32168, 0.33767)

TIFFS = {
    "grey": partial(write_tiff, pixels=GREY, shown=GREY / 255),
    "RGB": partial(write_tiff, photometric="rgb"),
    "white is 0": partial(
        write_tiff, pixels=255 - GREY, shown=GREY / 255, photometric="miniswhite"
    ),
    "palette": partial(
        write_tiff, pixels=GREY, shown=COLORS, photometric="palette", colormap=TABLE
    ),
    "CMYK": partial(write_tiff, pixels=INKS, shown=0.8 * LEVELS, photometric="separated"),
    "YCbCr": partial(write_pillow, mode="YCbCr"),
    "tiles": partial(write_tiff, photometric="rgb", tile=(16, 16), compression="zlib"),
    "LZW": partial(write_openimageio, pixels=RGB, compression="lzw"),
    "PACKBITS": partial(write_openimageio, pixels=RGB, compression="packbits"),
    "JPEG": partial(write_pillow, compression="jpeg", quality=100),
    "Zstandard": partial(write_pillow, compression="zstd"),
    "fax": partial(write_pillow, mode="1", compression="group4"),
    "channels in planes": partial(write_tiff, **SEPARATE),
    "orientation": partial(
        write_tiff, shown=TURNED, photometric="rgb", extratags=[(274, "H", 1, 6, True)]
    ),
    "alpha": partial(write_alpha, kind="unassalpha"),
    "associated alpha": partial(write_alpha, kind="assocalpha"),
    "a fourth band": partial(write_alpha, kind="unspecified", shown=LEVELS),
    "several pages": write_frames,
    "a profile of sRGB": partial(write_pillow, icc_profile=SRGB),
    "a profile that is not sRGB": partial(write_pillow, icc_profile=other_profile()),
    "white is 0, floats": partial(write_tiff, photometric="miniswhite", **FLOATS),
    "CMYK, floats": partial(
        write_tiff, pixels=INKS.astype(np.float32), photometric="separated", **REFUSED
    ),
    "CIELab": partial(write_tiff, photometric="cielab", **REFUSED),
    "YCbCr, 16 bits": partial(
        write_tiff, pixels=RGB.astype(np.uint16), photometric="ycbcr", subsampling=(1, 1), **REFUSED
    ),
    "signed, 16 bits": partial(
        write_tiff, pixels=GREY.astype(np.int16), photometric="minisblack", **REFUSED
    ),
    "integers, 64 bits": partial(
        write_tiff, pixels=GREY.astype(np.uint64), photometric="minisblack", **REFUSED
    ),
}
PNGS = {
    "1 bit": partial(write_pillow, mode="1"),
    "L, 8 bits": partial(write_pillow, mode="L"),
    "P, 8 bits": partial(write_pillow, mode="P"),
    "RGB, 8 bits": write_pillow,
    "LA, 8 bits": partial(write_pillow, mode="LA"),
    "RGBA, 8 bits": partial(write_pillow, mode="RGBA"),
    "orientation": partial(write_pillow, exif=exif(6), shown=TURNED),
    "a transparent entry of a palette": write_key,
    "a transparent value": partial(write_key, mode="L"),
    "a gamma that is not that of sRGB": partial(
        write_chunk, name=b"gAMA", data=(100_000).to_bytes(4, "big")
    ),
    "HDR (cICP)": partial(write_chunk, name=b"cICP", data=bytes([9, 16, 0, 1])),
    "animated": write_frames,
}
JPEG = {"quality": 100, "subsampling": 0}
AVIF = {"quality": 100, "subsampling": "4:4:4"}
OTHERS = [
    ("JPEG", "RGB", ".jpg", partial(write_pillow, **JPEG)),
    ("JPEG", "CMYK", ".jpg", partial(write_pillow, mode="CMYK", **JPEG)),
    (
        *("JPEG", "orientation", ".jpg"),
        partial(write_pillow, exif=b"Exif\0\0" + exif(6), shown=TURNED, **JPEG),
    ),
    (
        *("JPEG", "a profile that is not sRGB", ".jpg"),
        partial(write_pillow, icc_profile=other_profile(), **JPEG),
    ),
    ("WebP", "RGB", ".webp", partial(write_pillow, lossless=True)),
    ("WebP", "RGBA", ".webp", partial(write_pillow, mode="RGBA", lossless=True)),
    ("AVIF", "RGB", ".avif", partial(write_pillow, **AVIF)),
    ("BMP", "RGB", ".bmp", write_pillow),
    ("TGA", "RGB", ".tga", write_pillow),
    ("GIF", "grey", ".gif", partial(write_pillow, mode="L")),
    ("GIF", "a transparent entry", ".gif", write_key),
    ("GIF", "animated", ".gif", write_frames),
    ("JPEG 2000", "RGB", ".jp2", write_pillow),
    ("PGM, PPM", "RGB, white is 1023", ".ppm", partial(write_netpbm, white=1023)),
    ("Radiance HDR", "RGB", ".hdr", write_hdr),
    (
        *("Radiance HDR", "order +Y, -X", ".hdr"),
        partial(write_hdr, old=b"-Y 6 +X 8", new=b"+Y 6 -X 8", shown=LEVELS[::-1, ::-1]),
    ),
    (
        *("Radiance HDR", "order +X, -Y", ".hdr"),
        partial(write_hdr, old=b"-Y 6 +X 8", new=b"+X 6 -Y 8", shown=LEVELS.swapaxes(0, 1)),
    ),
    (
        *("Radiance HDR", "primaries of Radiance", ".hdr"),
        partial(
            write_hdr, old=b"\n\n", new=PRIMARIES + b".640 .330 .290 .600 .150 .060 .3333 .3333\n\n"
        ),
    ),
    ("Radiance HDR", "other primaries", ".hdr", partial(write_hdr, old=b"\n\n", new=P3)),
    (
        "Radiance HDR",
        "XYZ",
        ".hdr",
        partial(write_hdr, old=b"rle_rgbe", new=b"rle_xyze", shown=None),
    ),
    ("EXR", "RGB", ".exr", write_exr),
    ("EXR", "RGBA", ".exr", partial(write_exr, names="RGBA")),
    ("EXR", "other channels", ".exr", partial(write_exr, shown=None, names="XYZ")),
    (
        *("EXR", "a smaller data window", ".exr"),
        partial(write_exr, shown=wider(LEVELS), origin=(2, 1), window=(12, 9)),
    ),
    (
        *("EXR", "a larger data window", ".exr"),
        partial(write_exr, shown=LEVELS[:4, :5], window=(5, 4)),
    ),
    (
        *("EXR", "primaries that are not those of sRGB", ".exr"),
        partial(write_exr, chromaticities=ACES),
    ),
]
KINDS = [
    *(Kind("TIFF", what, ".tif", write) for what, write in TIFFS.items()),
    *(Kind("PNG", what, ".png", write) for what, write in PNGS.items()),
    *(Kind(*kind) for kind in OTHERS),
]
