"""Codes of light, written out by NumPy."""

import numpy as np


def to_linear(codes):
    """Linear light of sRGB codes, also above 1."""
    curve = ((np.maximum(codes, 0) + 0.055) / 1.055) ** 2.4
    return np.where(codes <= 0.04045, codes / 12.92, curve).astype(np.float32)


def to_coded(light):
    """sRGB codes of light, also above 1."""
    curve = 1.055 * np.maximum(light, 0) ** (1 / 2.4) - 0.055
    return np.where(light <= 0.0031308, 12.92 * light, curve).astype(np.float32)


def to_log(light):
    """Codes of the space "log" of light above 0."""
    return (np.log1p(100 * np.asarray(light)) / np.log(101)).astype(np.float32)


LUMINANCE = np.float32([0.212671, 0.715160, 0.072169])
"""Weights of red, green and blue in the luminance."""
