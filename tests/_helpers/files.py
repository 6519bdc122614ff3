"""Two pixels, files that Pillow does not write, and the arrays of a file."""

import struct
import zlib

import numpy as np

BYTES = np.array([[[0, 51, 102], [255, 204, 153]]], np.uint8)


def members_of(path):
    """The arrays of an .npz file, without its format and version."""
    with np.load(path, allow_pickle=False) as file:
        return {key: file[key] for key in file if key not in ("format", "version")}


def png(width, height, depth, kind, rows):
    """Make a PNG by hand: Pillow writes no 16-bit colour, and no false sizes."""

    def chunk(name, data):
        checksum = struct.pack(">I", zlib.crc32(name + data))
        return struct.pack(">I", len(data)) + name + data + checksum

    header = struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)
    pixels = zlib.compress(b"".join(b"\0" + row.tobytes() for row in rows))
    chunks = chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunks


def insert_chunk(path, name, data):
    """Insert a chunk behind the header of a PNG file."""
    content, body = path.read_bytes(), name + data
    chunk = struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))
    path.write_bytes(content[:33] + chunk + content[33:])


def exif(orientation):
    """EXIF data of an orientation."""
    return b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)


def tiff(width, height, bits, samples, photometric, data, compression=1):
    """Make a TIFF of one strip by hand: tifffile writes no odd numbers of bits."""
    tags = {256: width, 257: height, 258: None, 259: compression, 262: photometric, 273: None}
    tags |= {277: samples, 278: height, 279: len(data)}
    start = 8 + 2 + 12 * len(tags) + 4
    tags[258], tags[273] = start, start + 2 * samples + 8
    entries = b"".join(
        struct.pack("<HHII", tag, 3 if tag == 258 else 4, samples if tag == 258 else 1, value)
        if tag != 258 or samples > 2
        else struct.pack("<HHIHH", tag, 3, samples, bits, bits)
        for tag, value in tags.items()
    )
    depths = struct.pack(f"<{samples}H", *[bits] * samples) + bytes(8)
    head = b"II*\0" + struct.pack("<IH", 8, len(tags))
    return head + entries + bytes(4) + depths + data


def rewrite(path, **changed):
    """Change arrays of an .npz file; None leaves one out."""
    with np.load(path, allow_pickle=False) as file:
        arrays = {**file, **changed}
    with path.open("wb") as file:
        np.savez(file, **{key: value for key, value in arrays.items() if value is not None})
