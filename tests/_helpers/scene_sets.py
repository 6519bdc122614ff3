"""Sets for the scenes."""

import eigengs_dr as eg


def save_halves(folder):
    """Sets under the names that the scenes use, of two halves: red above, blue below."""

    def save(name, above, below, space):
        halves(above, below, space).save(folder / f"{name}.npz")

    red, blue = [0.9, 0.1, 0.1], [0.1, 0.1, 0.9]
    for name in ("floor", "floor-coded", "picture", "poster"):
        save(name, red, blue, "rgb" if name == "poster" else "linear")
    save("roughness", [0.2], [0.6], "data")
    maps = [("albedo", "linear", 3), ("roughness", "data", 1), ("normal", "normal", 3)]
    both = halves([*red, 0.2, 0.5, 0.5, 1], [*blue, 0.6, 0.6, 0.4, 0.9], "data", maps)
    both.save(folder / "tiles.npz")
    return folder


def halves(above, below, space, maps=()):
    """Two splats so wide that each is one colour all over its half."""
    return eg.Gaussians.from_arrays(
        [[8, 4], [8, 12]],
        [[0.02, 0, 0.5], [0.02, 0, 0.5]],
        [above, below],
        [0.0] * len(above),
        size=(16, 16),
        space=space,
        maps=maps,
        backend="llvm",
    )
