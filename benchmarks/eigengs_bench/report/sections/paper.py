"""Figures that the paper prints, which tables show beside ours: PSNR in YCbCr by steps.

Tai et al., "EigenGS Representation", CVPR 2025: tables 1 (FFHQ), 2 (transfer) and 3 (ablation).
"""

STEPS = ("images", "method", "0", "100", "500", "1,000", "5,000", "10,000")

# Rows of tables 1 and 2, by the set of ours that comes closest.
PRINTED = {
    "cats512": (
        STEPS,
        [
            ("FFHQ, 512x512", "GaussianImage", "-", "10.4", "21.8", "29.4", "39.2", "40.1"),
            ("FFHQ, 512x512", "EigenGS, 300", "28.0", "34.4", "36.4", "37.5", "40.7", "41.8"),
            ("FFHQ, 512x512", "EigenGS, 500", "28.9", "34.8", "36.7", "37.7", "40.8", "41.8"),
        ],
    ),
    "faces256": (
        STEPS,
        [
            ("CelebA, 256x256", "GaussianImage", "-", "10.3", "21.9", "30.0", "43.8", "45.2"),
            ("CelebA, 256x256", "of cats", "28.2", "36.2", "40.7", "43.2", "47.2", "48.2"),
            ("CelebA, 256x256", "of ImageNet", "28.7", "35.4", "39.6", "42.2", "46.3", "47.3"),
        ],
    ),
    "cats256": (
        STEPS,
        [("Cats, 256x256", "of ImageNet", "29.6", "37.6", "41.1", "42.9", "45.9", "46.6")],
    ),
}
# Rows of table 3, after 10,000 steps.
ABLATION = (
    ("fitted in", "split", "CelebA", "FFHQ", "Cats", "Cars"),
    [
        ("ycbcr", "split", "47.2", "41.8", "45.7", "44.7"),
        ("ycbcr", "whole", "48.0", "40.7", "46.1", "43.5"),
        ("rgb", "split", "39.5", "34.9", "38.5", "36.4"),
        ("rgb", "whole", "39.9", "33.3", "38.9", "35.1"),
    ],
)
