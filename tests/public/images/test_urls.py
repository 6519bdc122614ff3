"""URLs, which nothing reads or writes: one line says what to do instead."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import assert_refused, run

URL = "s3://bucket/photos/a.png"
PIXELS = np.full((16, 16, 3), 0.5, np.float32)

READERS = {
    "load_image": lambda out: eg.load_image(URL),
    "fit": lambda out: eg.fit(URL, 4, iterations=0),
    "maps": lambda out: eg.fit({"albedo": URL}, 4, iterations=0),
    "fit_large": lambda out: eg.fit_large(URL, out / "a.npz"),
    "fit_many": lambda out: eg.fit_many([URL], gaussians=4),
    "a pattern": lambda out: eg.fit_many("s3://bucket/*.png", gaussians=4),
    "a basis": lambda out: eg.Eigenbasis.from_images([URL], (4, 4)),
}


@pytest.mark.parametrize("reader", READERS)
def test_a_url_is_no_path_of_an_image(reader, tmp_path):
    with pytest.raises((OSError, ValueError)) as error:
        READERS[reader](tmp_path)
    assert str(error.value).startswith("s3://bucket/")
    assert str(error.value).endswith(": is a URL; download it first, and give the file")


@pytest.mark.parametrize(
    "command",
    [
        ("fit", URL),
        ("fit", "--map", f"albedo={URL}"),
        ("train", "s3://bucket"),
        ("view", __file__, "--image", URL),
    ],
)
def test_commands_take_no_urls(command, tmp_path):
    assert_refused(run(*command, "-o", tmp_path / "a.npz"), "is a URL; download it first")


def test_an_output_that_is_a_url_is_refused():
    result = eg.fit(PIXELS, 4, iterations=0)
    for write, url in (
        (result.save, "memory://out/a.npz"),
        (lambda url: eg.save_image(url, PIXELS), "memory://out/a.png"),
        (lambda url: eg.pack(result, url), "memory://out/a.egs"),
        (lambda url: eg.fit_large(PIXELS, url), "memory://out/a.npz"),
        (lambda url: eg.fit_many([PIXELS], url, gaussians=4), "memory://fits"),
    ):
        with pytest.raises(OSError, match=f"{url}: .*cannot be written to URLs"):
            write(url)
