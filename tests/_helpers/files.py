"""Files that Pillow does not write, and the arrays of a file."""

import struct
import zlib

import numpy as np


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


def tiff(width, height, data):
    """Make a TIFF of bytes of RGB in one strip that zlib has packed; it may lie about its size."""
    tags = {256: width, 257: height, 258: 122, 259: 8, 262: 2, 273: 128}
    tags |= {277: 3, 278: height, 279: len(data)}
    entries = b"".join(
        struct.pack("<HHII", tag, *((3, 3) if tag == 258 else (4, 1)), value)
        for tag, value in tags.items()
    )
    return b"II*\0" + struct.pack("<IH", 8, 9) + entries + bytes(4) + b"\x08\0" * 3 + data


def rewrite(path, **changed):
    """Change arrays of an .npz file; None leaves one out."""
    with np.load(path, allow_pickle=False) as file:
        arrays = {**file, **changed}
    with path.open("wb") as file:
        np.savez(file, **{key: value for key, value in arrays.items() if value is not None})
