"""Every way to write a file, by the name of its output, and what each does on a full disk."""

from contextlib import contextmanager

import eigengs_dr as eg
from _helpers.command import run
from _helpers.families import small_model
from _helpers.lit_models import LitFormula

SUFFIXES = ("png", "jpg", "webp", "bmp", "ppm", "tif", "exr", "hdr", "pfm")
PICTURES = tuple(f"picture.{suffix}" for suffix in SUFFIXES)
OUTPUTS = (
    *("set.npz", "fit.npz", "set.egs", *PICTURES, "deep.png", "page.html", "model.npz", "lit.npz"),
    *("command.npz", "report.json", "preview.png", "packed.egs", "drawn.png", "drawn.tif"),
    *("view.html", "blocks.npz"),
)


def writers(folder):
    """Functions that write an output each, from files in a folder."""
    photo = eg.sample("chelsea")[100:132, 150:182]
    few = {"iterations": 1, "progress": False}
    fit = eg.fit(photo, 4, **few)
    model, lit = small_model("llvm"), LitFormula().model()
    eg.save_image(folder / "in.png", photo)
    fit.gaussians.save(folder / "in.npz")
    quick = ("--gaussians", 4, "--iterations", 1, "--quiet")

    packed = ("pack", folder / "in.npz", "--max-psnr-drop", 20)

    def told(*command):
        result = run(*command)
        if result.exit_code:
            assert result.stderr.count("\n") == 1 and "Traceback" not in result.stderr, result
            raise OSError(result.stderr.strip())

    return {
        "set.npz": fit.gaussians.save,
        "fit.npz": fit.save,
        "set.egs": lambda out: eg.pack(fit.gaussians, out, max_psnr_drop=20),
        **{name: lambda out: eg.save_image(out, photo) for name in PICTURES},
        "deep.png": lambda out: eg.save_image(out, photo, bits=16),
        "page.html": lambda out: eg.view(fit.gaussians).save(out),
        "model.npz": model.save,
        "lit.npz": lit.save,
        "command.npz": lambda out: told("fit", folder / "in.png", "-o", out, *quick),
        "preview.png": lambda out: told("info", folder / "in.npz", "--preview", out),
        "report.json": lambda out: told(
            *packed, "-o", out.with_suffix(".json.egs"), "--report", out
        ),
        "packed.egs": lambda out: told(*packed, "-o", out),
        "drawn.png": lambda out: told("render", folder / "in.npz", "-o", out),
        "drawn.tif": lambda out: told("render", folder / "in.npz", "-o", out, "--scale", 2),
        "view.html": lambda out: told("view", folder / "in.npz", "-o", out),
        "blocks.npz": lambda out: eg.fit_large(photo, out, gaussians=4, **few),
    }


def refused(write, out):
    """The error of a writer; None if it writes."""
    try:
        write(out)
    except (OSError, ValueError) as error:
        return str(error)
    return None


@contextmanager
def shortened(limit):
    """Let no file be longer than a limit in bytes, as on a full disk."""
    import resource

    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))


def write_sets(photos, out):
    """Fit a folder of one image, and raise what its row says."""
    [row] = eg.fit_many(photos, out, gaussians=4, iterations=1, progress=False)
    if row.error:
        raise OSError(row.error)


def fill(folder, limit):
    """What writers say where no file may be longer than a limit in bytes, and what they leave.

    A limit below zero is as many bytes below the length of the whole file.
    """
    (folder / "photos").mkdir(parents=True)
    functions, said = writers(folder), {}
    eg.save_image(folder / "photos" / "a.png", eg.sample("chelsea")[100:132, 150:182])
    functions["sets"] = lambda out: write_sets(folder / "photos", out)
    for name, write in functions.items():
        out, longest = folder / name, limit
        if limit < 0:
            write(out)
            longest += 0 if out.is_dir() else out.stat().st_size
        old, before = out.read_bytes() if out.is_file() else None, set(folder.rglob("*"))
        with shortened(max(longest, 0)):
            error = refused(write, out)
        assert old is None or out.read_bytes() == old, name
        said[name] = error, [str(path) for path in sorted({*folder.rglob("*")} - before)]
    return said
