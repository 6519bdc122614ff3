"""Every kind of image file that is read or refused by its name, and how one is written."""

from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import OpenImageIO as oiio
import PIL
import pytest
import skimage
import tifffile
from PIL import Image, ImageCms

from _helpers.files import exif, insert_chunk, packed, png, tiff

H, W = 6, 8
RGB = np.random.default_rng(0).integers(0, 256, (H, W, 3), np.uint8)
RGB[0, :4] = [[0, 0, 0], [255, 255, 255], [255, 0, 0], [0, 0, 255]]
GREY = RGB[..., :1]
ALPHA = np.random.default_rng(1).integers(1, 256, (H, W, 1), np.uint8)
PALETTE = np.random.default_rng(2).integers(0, 256, (256, 3), np.uint8)
COLORS = PALETTE[GREY[..., 0]] / 255
OVER_WHITE = 1 - ALPHA / 255 * (1 - RGB / 255)
PEAKS = {"u1": 255, "u2": 65535, "u4": 2**32 - 1, "f2": 1, "f4": 1, "f8": 1}

NEEDS_PILLOW_13 = pytest.mark.skipif(
    int(PIL.__version__.split(".")[0]) < 13, reason="TIFF of YCbCr needs Pillow 13"
)


class Kind(NamedTuple):
    """A kind of file; `write(path)` returns the picture (H, W, 3 or 1), or None if none is due."""

    format: str
    what: str
    suffix: str
    write: object


def as_type(levels, dtype):
    """Levels from 0 to 1 as pixels of a type."""
    levels = np.asarray(levels, np.float64) * PEAKS[dtype]
    return levels.astype(dtype) if dtype[0] == "f" else np.rint(levels).astype(dtype)


def write_tiff(path, levels, dtype, shown=None, **options):
    pixels = as_type(levels, dtype)
    if options.get("planarconfig") == "separate":
        pixels = np.ascontiguousarray(np.moveaxis(pixels, 2, 0))
    pixels = pixels[..., 0] if pixels.shape[-1] == 1 else pixels
    tifffile.imwrite(path, pixels, **options)
    return levels if shown is None else shown


def write_alpha(path, dtype, kind, **options):
    colors = RGB / 255
    if kind == "assocalpha":
        colors = colors * (ALPHA / 255)
    levels = np.concatenate([colors, ALPHA / 255], axis=2)
    shown = RGB / 255 if kind == "unspecified" else OVER_WHITE
    return write_tiff(path, levels, dtype, shown, photometric="rgb", extrasamples=[kind], **options)


def write_separate_alpha(path, kind):
    return write_alpha(path, "u2", kind, planarconfig="separate")


def write_palette_tiff(path, dtype):
    table = np.zeros((3, 256 if dtype == "u1" else 65536), np.uint16)
    table[:, :256] = PALETTE.T.astype(np.uint16) * 257
    tifffile.imwrite(path, GREY[..., 0].astype(dtype), photometric="palette", colormap=table)
    return COLORS


def write_cmyk_tiff(path, dtype):
    inks = np.concatenate([255 - RGB, np.full((H, W, 1), 51)], axis=2) / 255
    return write_tiff(path, inks, dtype, RGB / 255 * 0.8, photometric="separated")


def write_integers(path, dtype):
    tifffile.imwrite(path, GREY[..., 0].astype(dtype), photometric="minisblack")


def write_odd_bits(path, bits, photometric):
    samples, levels = (3, RGB) if photometric == 2 else (1, GREY)
    values = levels.astype(np.int64) * (2**bits - 1) // 255
    data = b"".join(packed(row.ravel().tolist(), bits) for row in values)
    path.write_bytes(tiff(W, H, bits, samples, photometric, data))
    shown = values / (2**bits - 1)
    return 1 - shown if photometric == 0 else shown


def write_openimageio(path, pixels, shown=None, **attributes):
    image = oiio.ImageBuf(np.ascontiguousarray(pixels))
    image.set_write_format("float" if pixels.dtype.kind == "f" else pixels.dtype.name)
    for name, value in attributes.items():
        image.specmod().attribute(name, value)
    assert image.write(str(path)), image.geterror()
    return shown


def write_pillow(path, mode="RGB", shown=None, **options):
    image = Image.fromarray(RGB)
    if mode in ("L", "I;16"):
        pixels = GREY[..., 0] if mode == "L" else GREY[..., 0].astype(np.uint16) * 257
        image, shown = Image.fromarray(pixels), GREY / 255
    elif mode == "1":
        image, shown = Image.fromarray(GREY[..., 0] > 127), (GREY > 127) * 1.0
    elif mode == "P":
        image, shown = Image.fromarray(GREY[..., 0], "P"), COLORS
        image.putpalette(PALETTE.tobytes())
    elif mode == "RGBA":
        image, shown = Image.fromarray(np.concatenate([RGB, ALPHA], 2)), OVER_WHITE
    elif mode == "LA":
        image = Image.fromarray(np.concatenate([GREY, ALPHA], 2), "LA")
        shown = 1 - ALPHA / 255 * (1 - GREY / 255)
    elif mode != "RGB":
        image = image.convert(mode)
    image.save(path, **options)
    return RGB / 255 if shown is None else shown


def write_frames(path, **options):
    others = [Image.new("RGB", (W, H), color) for color in ("red", "lime")]
    return write_pillow(path, save_all=True, append_images=others, **options)


def write_key(path, mode="P", key=3):
    """A palette or grey image, of which one value is transparent."""
    shown = write_pillow(path, mode, transparency=key)
    return np.where(key == GREY, 1, shown)


def write_png16(path, kind, chunks=(), turn=lambda image: image, key=None):
    levels = {2: RGB, 4: np.concatenate([GREY, ALPHA], 2), 6: np.concatenate([RGB, ALPHA], 2)}
    levels = levels.get(kind, GREY)
    path.write_bytes(png(W, H, 16, kind, (levels.astype(">u2") * 257)))
    for name, data in chunks:
        insert_chunk(path, name, data)
    colors = levels[..., : 1 if kind in (0, 4) else 3] / 255
    shown = 1 - ALPHA / 255 * (1 - colors) if kind in (4, 6) else colors
    if key is not None:
        shown = np.where((levels == key).all(axis=2, keepdims=True), 1, shown)
    return turn(shown)


def write_chunk(path, name, data):
    shown = write_pillow(path)
    insert_chunk(path, name, data)
    return shown


def key_of(*levels):
    return b"".join((257 * level).to_bytes(2, "big") for level in levels)


def write_netpbm(path, kind, white):
    channels = 3 if kind in ("P3", "P6") else 1
    values = (RGB[..., :channels].astype(np.int64) * white) // 255
    head = f"{kind}\n# a comment\n{W} {H}\n{white}\n".encode()
    if kind in ("P2", "P3"):
        body = " ".join(map(str, values.ravel())).encode()
    else:
        body = values.astype(">u2" if white > 255 else "u1").tobytes()
    path.write_bytes(head + body)
    return values / white


def write_hdr(path, order=None):
    write_openimageio(path, (RGB / 255).astype(np.float32))
    shown = RGB / 255
    if order is not None:
        standard = f"-Y {H} +X {W}".encode()
        content = path.read_bytes()
        assert standard in content
        path.write_bytes(content.replace(standard, order[0]))
        shown = order[1](shown)
    return shown


def write_primaries(path, primaries):
    shown = write_hdr(path)
    head, gap, rows = path.read_bytes().partition(b"\n\n")
    path.write_bytes(head + b"\nPRIMARIES= " + primaries + gap + rows)
    return shown


def write_xyze(path):
    write_hdr(path)
    path.write_bytes(path.read_bytes().replace(b"rle_rgbe", b"rle_xyze"))


def write_exr(path, origin=(0, 0), window=None, names=("R", "G", "B"), **attributes):
    pixels = np.concatenate([RGB, ALPHA], 2)[..., : len(names)] / 255
    spec = oiio.ImageSpec(W, H, len(names), "float")
    spec.channelnames = names
    spec.x, spec.y = origin
    spec.full_x = spec.full_y = 0
    spec.full_width, spec.full_height = window or (W, H)
    for name, value in attributes.items():
        spec.attribute(name, "float[8]", value)
    file = oiio.ImageOutput.create(str(path))
    assert (
        file.open(str(path), spec) and file.write_image(pixels.astype(np.float32)) and file.close()
    )
    if names[:3] != ("R", "G", "B"):
        return None
    shown = np.zeros((spec.full_height + 2 * H, spec.full_width + 2 * W, 3))
    shown[H + origin[1] :, W + origin[0] :][:H, :W] = pixels[..., :3]
    return shown[H : H + spec.full_height, W : W + spec.full_width]


def other_profile():
    """A profile whose colours are not those of sRGB: that of a photo of scikit-image."""
    return Image.open(Path(skimage.__file__).parent / "data/rocket.jpg").info["icc_profile"]


def srgb_profile():
    return ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def turned(image):
    """Turn as orientation 6 says."""
    return np.rot90(image, -1)


RADIANCE = {
    "+Y+X": lambda image: image[::-1],
    "-Y-X": lambda image: image[:, ::-1],
    "+Y-X": lambda image: image[::-1, ::-1],
    "+X-Y": lambda image: image.swapaxes(0, 1),
    "+X+Y": lambda image: np.rot90(image),  # columns from the left, each from its bottom up
    "-X-Y": lambda image: np.rot90(image, -1),
    "-X+Y": lambda image: image.swapaxes(0, 1)[::-1, ::-1],
}
"""How the rows of a Radiance file lie, by its first and its second axis."""


def refused(write, **options):
    """A writer of a file that cannot be read."""

    def run(path):
        write(path, **options)

    return run


TYPES = {"u1": "8 bits", "u2": "16 bits", "u4": "32 bits", "f2": "16-bit floats", "f4": "floats"}
GREYS, COLORED = {"levels": GREY / 255}, {"levels": RGB / 255, "photometric": "rgb"}
INVERTED = {"levels": 1 - GREY / 255, "shown": GREY / 255, "photometric": "miniswhite"}
ALPHAS = {"unassalpha": "alpha", "assocalpha": "associated alpha", "unspecified": "a fourth band"}
CICP = bytes([9, 16, 0, 1])
GAMMA = (100_000).to_bytes(4, "big")


def tiff_kinds():
    for dtype, name in TYPES.items():
        yield f"grey, {name}", partial(write_tiff, dtype=dtype, **GREYS)
        yield f"RGB, {name}", partial(write_tiff, dtype=dtype, **COLORED)
    yield "grey, 64-bit floats", partial(write_tiff, dtype="f8", **GREYS)
    for bits in (1, 2, 4, 12):
        yield f"grey, {bits} bits", partial(write_odd_bits, bits=bits, photometric=1)
        yield f"white is 0, {bits} bits", partial(write_odd_bits, bits=bits, photometric=0)
        yield f"RGB, {bits} bits", partial(write_odd_bits, bits=bits, photometric=2)
    for dtype in ("u1", "u2", "u4"):
        yield f"white is 0, {TYPES[dtype]}", partial(write_tiff, dtype=dtype, **INVERTED)
    yield "white is 0, floats", refused(write_tiff, dtype="f4", **INVERTED)
    for extra, name in ALPHAS.items():
        for dtype in ("u1", "u2", "f4"):
            options = {"dtype": dtype, "kind": extra}
            yield f"{name}, {TYPES[dtype]}", partial(write_alpha, **options)
        planes = partial(write_separate_alpha, kind=extra)
        yield f"{name}, 16 bits, channels in planes", planes
    for dtype in ("u1", "u2"):
        yield f"palette, {TYPES[dtype]}", partial(write_palette_tiff, dtype=dtype)
        yield f"CMYK, {TYPES[dtype]}", partial(write_cmyk_tiff, dtype=dtype)
        lab = {"levels": RGB / 255, "photometric": "cielab", "dtype": dtype}
        yield f"CIELab, {TYPES[dtype]}", refused(write_tiff, **lab)
    yield "CMYK, floats", refused(write_cmyk_tiff, dtype="f4")
    yield "YCbCr, 8 bits", partial(write_pillow, mode="YCbCr")
    ycbcr = {"levels": RGB / 255, "photometric": "ycbcr", "subsampling": (1, 1), "dtype": "u2"}
    yield "YCbCr, 16 bits", refused(write_tiff, **ycbcr)
    for dtype in ("i1", "i2", "i4", "u8"):
        name = f"{'signed' if dtype[0] == 'i' else 'integers'}, {8 * int(dtype[1])} bits"
        yield name, refused(write_integers, dtype=dtype)
    for dtype in ("u1", "u2", "f4"):
        yield (
            f"tiles, Deflate, {TYPES[dtype]}",
            partial(write_tiff, dtype=dtype, tile=(16, 16), compression="zlib", **COLORED),
        )
        pixels = as_type(RGB / 255, dtype)
        for codec in ("lzw", "packbits"):
            yield (
                f"{codec.upper()}, {TYPES[dtype]}",
                partial(write_openimageio, pixels=pixels, shown=RGB / 255, compression=codec),
            )
        planes = {"dtype": dtype, "planarconfig": "separate", **COLORED}
        yield f"channels in planes, {TYPES[dtype]}", partial(write_tiff, **planes)
        sides = {"extratags": [(274, "H", 1, 6, True)], "dtype": dtype, "shown": turned(RGB / 255)}
        yield f"orientation, {TYPES[dtype]}", partial(write_tiff, **sides, **COLORED)
    yield "JPEG, 8 bits", partial(write_pillow, compression="jpeg", quality=100)
    yield "Zstandard, 8 bits", partial(write_pillow, compression="zstd")
    yield "fax, 1 bit", partial(write_pillow, mode="1", compression="group4")
    yield "several pages", write_frames
    yield "a profile that is not sRGB", partial(write_pillow, icc_profile=other_profile())
    yield "a profile of sRGB", partial(write_pillow, icc_profile=srgb_profile())


def png_kinds():
    for mode in ("1", "L", "I;16", "P", "RGB", "LA", "RGBA"):
        yield (
            {"1": "1 bit", "I;16": "grey, 16 bits"}.get(mode, f"{mode}, 8 bits"),
            partial(write_pillow, mode=mode),
        )
    for kind, name in {2: "RGB", 4: "LA", 6: "RGBA"}.items():
        yield f"{name}, 16 bits", partial(write_png16, kind=kind)
    yield "a transparent entry of a palette", partial(write_key, key=int(GREY[2, 2, 0]))
    yield "a transparent value, grey, 8 bits", partial(write_key, mode="L", key=int(GREY[2, 2, 0]))
    for kind, levels in ((0, GREY), (2, RGB)):
        key = levels[2, 2].tolist()
        yield (
            f"a transparent value, {'RGB' if kind else 'grey'}, 16 bits",
            partial(write_png16, kind=kind, key=key, chunks=[(b"tRNS", key_of(*key))]),
        )
    yield "orientation, 8 bits", partial(write_pillow, exif=exif(6), shown=turned(RGB / 255))
    sides = [(b"eXIf", exif(6))]
    yield "orientation, 16 bits", partial(write_png16, kind=2, chunks=sides, turn=turned)
    yield "a gamma that is not that of sRGB", partial(write_chunk, name=b"gAMA", data=GAMMA)
    yield "HDR (cICP), 8 bits", partial(write_chunk, name=b"cICP", data=CICP)
    yield "HDR (cICP), 16 bits", partial(write_png16, kind=2, chunks=[(b"cICP", CICP)])
    yield "a profile that is not sRGB", partial(write_pillow, icc_profile=other_profile())
    yield "animated", write_frames


def other_kinds():
    for suffix, options in {
        ".jpg": {"quality": 100, "subsampling": 0},
        ".webp": {"lossless": True},
        ".avif": {"quality": 100, "subsampling": "4:4:4"},
        ".bmp": {},
        ".tga": {},
        ".gif": {},
        ".jp2": {},
    }.items():
        name = {"jpg": "JPEG", "jp2": "JPEG 2000", "webp": "WebP"}.get(
            suffix[1:], suffix[1:].upper()
        )
        if suffix != ".gif":
            yield name, "RGB", suffix, partial(write_pillow, **options)
        if suffix != ".avif":
            yield name, "grey", suffix, partial(write_pillow, mode="L", **options)
        if suffix in (".webp", ".tga", ".jp2", ".avif"):
            yield name, "RGBA", suffix, partial(write_pillow, mode="RGBA", **options)
        if suffix in (".jpg", ".webp", ".avif"):
            sides = {"exif": exif(6), "shown": turned(RGB / 255), **options}
            if suffix != ".avif":
                sides["exif"] = b"Exif\0\0" + sides["exif"]
            yield name, "orientation", suffix, partial(write_pillow, **sides)
        if suffix == ".jpg":
            yield name, "CMYK", suffix, partial(write_pillow, mode="CMYK", **options)
            profile = {"icc_profile": other_profile(), **options}
            yield name, "a profile that is not sRGB", suffix, partial(write_pillow, **profile)
        if suffix in (".webp", ".gif"):
            yield name, "animated", suffix, partial(write_frames, **options)
    yield "GIF", "a transparent entry", ".gif", partial(write_key, key=int(GREY[2, 2, 0]))
    yield "JPEG 2000", "grey, 16 bits", ".jp2", partial(write_pillow, mode="I;16")
    for kind, name in (("P2", "text"), ("P3", "text"), ("P5", "binary"), ("P6", "binary")):
        for white in (15, 255, 1023, 65535):
            what = f"{'RGB' if kind in ('P3', 'P6') else 'grey'}, {name}, white is {white}"
            yield "PGM, PPM", what, ".ppm", partial(write_netpbm, kind=kind, white=white)
    yield "Radiance HDR", "RGB", ".hdr", write_hdr
    for order, turn in RADIANCE.items():
        yield (
            "Radiance HDR",
            f"order {order[:2]}, {order[2:]}",
            ".hdr",
            partial(write_hdr, order=(f"{order[:2]} {H} {order[2:]} {W}".encode(), turn)),
        )
    yield "Radiance HDR", "XYZ", ".hdr", write_xyze
    own = b"0.640 0.330 0.290 0.600 0.150 0.060 0.3333 0.3333"
    wide = b".68 .32 .265 .69 1.5e-1 .06 .3127 .329"  # P3
    for what, primaries in (("primaries of Radiance", own), ("other primaries", wide)):
        yield "Radiance HDR", what, ".hdr", partial(write_primaries, primaries=primaries)
    yield "EXR", "RGB", ".exr", write_exr
    yield "EXR", "RGBA", ".exr", partial(write_exr, names=("R", "G", "B", "A"))
    yield "EXR", "other channels", ".exr", refused(write_exr, names=("X", "Y", "Z"))
    yield "EXR", "a smaller data window", ".exr", partial(write_exr, origin=(2, 1), window=(12, 9))
    yield "EXR", "a larger data window", ".exr", partial(write_exr, origin=(0, 0), window=(5, 4))
    wide = {"chromaticities": (0.7347, 0.2653, 0, 1, 0.0001, -0.077, 0.32168, 0.33767)}
    yield "EXR", "primaries that are not those of sRGB", ".exr", partial(write_exr, **wide)


KINDS = [
    *(Kind("TIFF", what, ".tif", write) for what, write in tiff_kinds()),
    *(Kind("PNG", what, ".png", write) for what, write in png_kinds()),
    *(Kind(*kind) for kind in other_kinds()),
]
