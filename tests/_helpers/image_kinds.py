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


def write_hdr(path, old, new, shown):
    """A Radiance file in which bytes of the header are others, or of which primaries are named."""
    write_openimageio(path, LEVELS.astype(np.float32))
    content = path.read_bytes()
    if new and not old:
        old, new = b"\n\n", b"\nPRIMARIES= " + new + b"\n\n"
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
TABLE = np.ascontiguousarray(PALETTE.T.astype(np.uint16) * 257)
INKS = np.concatenate([255 - RGB, np.full((H, W, 1), 51, np.uint8)], axis=2)
PLANES = np.moveaxis(RGB, 2, 0)
UPRIGHT = [(274, "H", 1, 6, True)]
"""A tag of TIFF: the left side is the top."""


def tiff_kinds():
    """Kinds of TIFF that tifffile writes: pixels, the picture, and options."""
    color = {"photometric": "rgb"}
    palette = {"photometric": "palette", "colormap": TABLE}
    return {
        "grey": (GREY, GREY / 255, {}),
        "RGB": (RGB, LEVELS, color),
        "white is 0": (255 - GREY, GREY / 255, {"photometric": "miniswhite"}),
        "palette": (GREY, COLORS, palette),
        "CMYK": (INKS, 0.8 * LEVELS, {"photometric": "separated"}),
        "tiles": (RGB, LEVELS, color | {"tile": (16, 16), "compression": "zlib"}),
        "channels in planes": (PLANES, LEVELS, color | {"planarconfig": "separate"}),
        "orientation": (RGB, TURNED, color | {"extratags": UPRIGHT}),
        "white is 0, floats": (GREY.astype("f4"), None, {"photometric": "miniswhite"}),
        "CMYK, floats": (INKS.astype("f4"), None, {"photometric": "separated"}),
        "CIELab": (RGB, None, {"photometric": "cielab"}),
        "YCbCr, 16 bits": (RGB.astype("u2"), None, {"photometric": "ycbcr", "subsampling": (1, 1)}),
        "signed, 16 bits": (GREY.astype("i2"), None, {"photometric": "minisblack"}),
        "integers, 64 bits": (GREY.astype("u8"), None, {"photometric": "minisblack"}),
    }


def other_tiff_kinds():
    return {
        "YCbCr": partial(write_pillow, mode="YCbCr"),
        "LZW": partial(write_openimageio, pixels=RGB, compression="lzw"),
        "PACKBITS": partial(write_openimageio, pixels=RGB, compression="packbits"),
        "JPEG": partial(write_pillow, compression="jpeg", quality=100),
        "Zstandard": partial(write_pillow, compression="zstd"),
        "fax": partial(write_pillow, mode="1", compression="group4"),
        "alpha": partial(write_alpha, kind="unassalpha"),
        "associated alpha": partial(write_alpha, kind="assocalpha"),
        "a fourth band": partial(write_alpha, kind="unspecified", shown=LEVELS),
        "several pages": write_frames,
        "a profile of sRGB": partial(write_pillow, icc_profile=SRGB),
        "a profile that is not sRGB": partial(write_pillow, icc_profile=other_profile()),
    }


def png_kinds():
    modes = {"1": "1 bit", **{mode: f"{mode}, 8 bits" for mode in ("L", "P", "RGB", "LA", "RGBA")}}
    gamma = {"name": b"gAMA", "data": (100_000).to_bytes(4, "big")}
    return {
        **{what: partial(write_pillow, mode=mode) for mode, what in modes.items()},
        "orientation": partial(write_pillow, exif=exif(6), shown=TURNED),
        "a transparent entry of a palette": write_key,
        "a transparent value": partial(write_key, mode="L"),
        "a gamma that is not that of sRGB": partial(write_chunk, **gamma),
        "HDR (cICP)": partial(write_chunk, name=b"cICP", data=bytes([9, 16, 0, 1])),
        "animated": write_frames,
    }


FORMATS = {
    "JPEG": (".jpg", {"quality": 100, "subsampling": 0}),
    "WebP": (".webp", {"lossless": True}),
    "AVIF": (".avif", {"quality": 100, "subsampling": "4:4:4"}),
    "BMP": (".bmp", {}),
    "TGA": (".tga", {}),
    "JPEG 2000": (".jp2", {}),
}
"""Other formats that Pillow writes: suffixes, and options."""


def other_kinds():
    for kind, (suffix, options) in FORMATS.items():
        yield kind, "RGB", suffix, partial(write_pillow, **options)
    suffix, options = FORMATS["JPEG"]
    sides = {"exif": b"Exif\0\0" + exif(6), "shown": TURNED}
    profile = {"icc_profile": other_profile()}
    yield "JPEG", "CMYK", suffix, partial(write_pillow, mode="CMYK", **options)
    yield "JPEG", "orientation", suffix, partial(write_pillow, **sides, **options)
    yield "JPEG", "a profile that is not sRGB", suffix, partial(write_pillow, **profile, **options)
    yield "WebP", "RGBA", ".webp", partial(write_pillow, mode="RGBA", lossless=True)
    yield "GIF", "grey", ".gif", partial(write_pillow, mode="L")
    yield "GIF", "a transparent entry", ".gif", write_key
    yield "GIF", "animated", ".gif", write_frames
    yield "PGM, PPM", "RGB, white is 1023", ".ppm", partial(write_netpbm, white=1023)


RADIANCE = {
    "RGB": (b"", b"", LEVELS),
    "order +Y, -X": (b"-Y 6 +X 8", b"+Y 6 -X 8", LEVELS[::-1, ::-1]),
    "order +X, -Y": (b"-Y 6 +X 8", b"+X 6 -Y 8", LEVELS.swapaxes(0, 1)),
    "primaries of Radiance": (b"", b".640 .330 .290 .600 .150 .060 .3333 .3333", LEVELS),
    "other primaries": (b"", b".68 .32 .265 .69 1.5e-1 .06 .3127 .329", LEVELS),
    "XYZ": (b"rle_rgbe", b"rle_xyze", None),
}
"""Kinds of Radiance files: bytes of the header, others or primaries in their place, the picture."""


EXRS = {
    "RGB": {},
    "RGBA": {"names": "RGBA"},
    "other channels": {"names": "XYZ", "shown": None},
    "a smaller data window": {"shown": wider(LEVELS), "origin": (2, 1), "window": (12, 9)},
    "a larger data window": {"shown": LEVELS[:4, :5], "window": (5, 4)},
    "primaries that are not those of sRGB": {
        "chromaticities": (0.7347, 0.2653, 0, 1, 0.0001, -0.077, 0.32168, 0.33767)
    },
}


def all_kinds():
    for what, (pixels, shown, options) in tiff_kinds().items():
        write = partial(write_tiff, pixels=pixels, shown=shown, **options)
        yield Kind("TIFF", what, ".tif", write)
    for what, write in other_tiff_kinds().items():
        yield Kind("TIFF", what, ".tif", write)
    for what, write in png_kinds().items():
        yield Kind("PNG", what, ".png", write)
    for kind in other_kinds():
        yield Kind(*kind)
    for what, (old, new, shown) in RADIANCE.items():
        write = partial(write_hdr, old=old, new=new, shown=shown)
        yield Kind("Radiance HDR", what, ".hdr", write)
    for what, options in EXRS.items():
        yield Kind("EXR", what, ".exr", partial(write_exr, **options))


KINDS = list(all_kinds())
