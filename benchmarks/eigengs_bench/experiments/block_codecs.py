"""Block compression of GPUs, as far as its packages are installed: ASTC and BC7.

``pip install astc-encoder-py`` brings Arm's encoder, ``pip install etcpak texture2ddecoder`` one
of BC7 (the decoder of etcpak 0.9.15 crashes). Blocks of both take 16 bytes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eigengs_dr.image.io import to_8bit

Bytes = NDArray[np.uint8]

ASTC_BLOCKS = (4, 6, 8, 10, 12)
BLOCK_BYTES = 16


def codecs() -> dict[str, tuple[int, Callable[[Bytes], Bytes]]]:
    """Return for each codec that is installed the side of a block, and what encodes and decodes.

    The functions take and return RGBA of 8 bits, shape (H, W, 4).
    """
    found: dict[str, tuple[int, Callable[[Bytes], Bytes]]] = {}
    try:
        import astc_encoder  # noqa: F401

        for side in ASTC_BLOCKS:
            found[f"ASTC {side}x{side}"] = side, _astc(side)
    except ImportError:
        pass
    try:
        import etcpak  # noqa: F401
        import texture2ddecoder  # noqa: F401

        found["BC7"] = 4, _bc7
    except ImportError:
        pass
    return found


def coded(image: NDArray[Any], side: int, code: Callable[[Bytes], Bytes]) -> tuple[int, Any]:
    """Return the bytes of an image (H, W, C) by a codec, and its pixels after it."""
    height, width, channels = image.shape
    rgba = np.full((height, width, 4), 255, np.uint8)
    rgba[..., :3] = to_8bit(image)
    pixels = code(rgba)[..., :channels].astype(np.float32) / 255
    return BLOCK_BYTES * -(-width // side) * -(-height // side), pixels


def _astc(side: int) -> Callable[[Bytes], Bytes]:
    def code(rgba: Bytes) -> Bytes:
        import astc_encoder as astc

        height, width, _ = rgba.shape
        config = astc.ASTCConfig(astc.ASTCProfile.LDR, side, side)
        context, swizzle = astc.ASTCContext(config), astc.ASTCSwizzle.from_str("RGBA")
        source = astc.ASTCImage(astc.ASTCType.U8, width, height, data=rgba.tobytes())
        packed = context.compress(source, swizzle)
        empty = astc.ASTCImage(astc.ASTCType.U8, width, height)
        shown = context.decompress(packed, empty, swizzle)
        return np.frombuffer(shown.data, np.uint8).reshape(rgba.shape)

    return code


def _bc7(rgba: Bytes) -> Bytes:
    import etcpak
    import texture2ddecoder

    height, width, _ = rgba.shape
    packed = etcpak.compress_bc7(rgba.tobytes(), width, height)
    bgra = np.frombuffer(texture2ddecoder.decode_bc7(packed, width, height), np.uint8)
    return bgra.reshape(rgba.shape)[..., [2, 1, 0, 3]]
