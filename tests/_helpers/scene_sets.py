"""Sets for the scenes."""

import eigengs_dr as eg


def save_halves(folder):
    """Sets under the names that the scenes use, of two halves: red above, blue below."""

    def save(name, above, below, space):
        # Two splats so wide that each is one colour all over its half.
        gaussians = eg.Gaussians.from_arrays(
            [[8, 4], [8, 12]],
            [[0.02, 0, 0.5], [0.02, 0, 0.5]],
            [above, below],
            [0.0] * len(above),
            size=(16, 16),
            space=space,
            backend="llvm",
        )
        gaussians.save(folder / f"{name}.npz")

    for name in ("floor", "floor-coded", "picture", "poster", "tiles-color"):
        save(name, [0.9, 0.1, 0.1], [0.1, 0.1, 0.9], "rgb" if name == "poster" else "linear")
    save("tiles-roughness", [0.2], [0.6], "data")
    save("tiles-normals", [0.5, 0.5, 1], [0.6, 0.4, 0.9], "data")
    return folder
