"""Files and URLs where images are taken, and fits where sets are."""

import asyncio
import http.server
import threading
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from functools import partial
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.command import assert_refused, run, succeeded
from _helpers.errors import refused
from _helpers.families import small_model
from _helpers.packed import few_groups
from eigengs_dr.image import remote

pytest.importorskip("fsspec")

QUICK = {"gaussians": 60, "iterations": 10}


class Server(http.server.SimpleHTTPRequestHandler):
    """Files, what leads elsewhere, and nothing at all; it notes what is asked for."""

    asked: ClassVar[list] = []

    def log_message(self, *_):
        pass

    def do_GET(self):
        self.asked.append(self.path)
        kind, _, rest = self.path[1:].partition("/")
        if kind == "to":
            self.send_response(302)
            self.send_header("Location", rest)
            self.end_headers()
        elif kind == "silent":
            time.sleep(2)
        else:
            super().do_GET()


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """A folder with four photos of 32x32, and an archive of them."""
    folder = tmp_path_factory.mktemp("photos")
    photo = eg.sample("coffee")
    with zipfile.ZipFile(folder / "all.zip", "w") as archive:
        for k in range(4):
            eg.save_image(folder / f"{k}.png", photo[40 * k :, 60 * k :][:32, :32])
            archive.write(folder / f"{k}.png", f"in/{k}.png")
    return folder


@pytest.fixture(scope="module")
def served(photos):
    """The URL of the folder."""
    pytest.importorskip("aiohttp")
    with http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), partial(Server, directory=photos)
    ) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


@pytest.fixture(params=["file", "zip", "path"])
def place(request, photos):
    """The folder of the photos in several ways."""
    if request.param == "path":
        return str(photos)
    return f"file://{photos}" if request.param == "file" else f"zip://in/{{}}::{photos}/all.zip"


def item(place, name):
    return place.format(name) if "{}" in place else f"{place}/{name}"


def test_an_image_may_be_a_file_or_a_url(place, photos, tmp_path):
    url, pixels = item(place, "1.png"), eg.load_image(photos / "1.png")
    np.testing.assert_array_equal(eg.load_image(url), pixels)
    want = eg.fit(pixels, **QUICK).image
    np.testing.assert_array_equal(eg.fit(url, **QUICK).image, want)
    eg.fit(url, **{**QUICK, "gaussians": [15, 60]})
    assert eg.fit(url, space="data", **QUICK).gaussians.channels == 3
    found = eg.fit({"albedo": url, "roughness": url}, **QUICK)
    assert list(found.maps) == ["albedo", "roughness"]
    large = eg.fit_large(url, tmp_path / "large.npz", block=32, **QUICK)
    assert len(large.gaussians) == 60


def test_a_url_of_http(served, tmp_path):
    assert eg.load_image(f"{served}/2.png").shape == (32, 32, 3)
    with pytest.raises(OSError, match=rf"{served}/none.png: cannot be read"):
        eg.load_image(f"{served}/none.png")
    succeeded(run("fit", f"{served}/2.png", "-o", tmp_path / "a.npz", "--iterations", 5))
    assert eg.Gaussians.load(tmp_path / "a.npz").width == 32


def test_a_url_is_asked_once(served, tmp_path):
    Server.asked.clear()
    eg.load_image(f"{served}/2.png")
    succeeded(run("fit", f"{served}/1.png", "-o", tmp_path / "a.npz", "--iterations", 1))
    eg.fit_many([f"{served}/3.png"], gaussians=20, iterations=1)
    assert Server.asked == ["/2.png", "/1.png", "/3.png"]


def test_a_silent_server_is_given_up(served, monkeypatch):
    remote._web_options.cache_clear()
    monkeypatch.setattr(remote, "SILENCE", 0.2)
    started = time.monotonic()
    with pytest.raises(OSError, match=r"silent/a.png: cannot be read \(.*[Tt]imeout"):
        eg.load_image(f"{served}/silent/a.png")
    assert time.monotonic() - started < 1.5
    remote._web_options.cache_clear()


def test_where_a_server_may_lead(served):
    assert eg.load_image(f"{served}/to//2.png").shape == (32, 32, 3)
    with pytest.raises(OSError, match=r"cannot be read .*ftp://, which is not followed"):
        eg.load_image(f"{served}/to/ftp://127.0.0.1/a.png")


@pytest.mark.parametrize(
    ("here", "there", "kept"),
    [
        ("http://8.8.8.8/a", "/b", True),
        ("http://8.8.8.8/a", "https://9.9.9.9/b", True),
        ("http://10.0.0.1/a", "http://127.0.0.1/b", True),
        ("https://8.8.8.8/a", "http://8.8.8.8/b", False),
        ("http://8.8.8.8/a", "file:///etc/passwd", False),
        ("http://8.8.8.8/a", "http://localhost:80/b", False),
        ("http://8.8.8.8/a", "http://169.254.169.254/b", False),
        ("http://8.8.8.8/a", "//[::1]/b", False),
        ("http://8.8.8.8/a", "http://[::ffff:10.0.0.1]/b", False),
    ],
)
def test_public_servers_lead_to_no_private_ones(here, there, kept):
    """Nobody's program may be led to what only its own network may read."""
    yarl = pytest.importorskip("yarl")
    response = SimpleNamespace(headers={"Location": there})
    redirection = SimpleNamespace(url=yarl.URL(here), response=response)
    check = remote._check_redirection(None, None, redirection)
    # A browser that other tests have opened keeps the loop of this thread running.
    with ThreadPoolExecutor(1) as thread:
        checked = thread.submit(asyncio.run, check)
        with nullcontext() if kept else pytest.raises(OSError, match="which is not followed"):
            checked.result()


def test_a_url_is_read_up_to_a_limit(served, photos, monkeypatch):
    (photos / "large.png").write_bytes((photos / "1.png").read_bytes() + bytes(2 << 20))
    assert eg.load_image(f"{served}/large.png").shape == (32, 32, 3)
    monkeypatch.setenv("EIGENGS_DR_MAX_FILE_MB", "1")
    with refused(ValueError, rf"{served}/large.png: has more than 1 MB; .*EIGENGS_DR_MAX_FILE_MB"):
        eg.load_image(f"{served}/large.png")
    (photos / "large.png").unlink()


def test_a_warning_names_the_url(photos):
    Image.new("RGBA", (8, 8), (0, 0, 0, 9)).save(photos / "clear.webp")
    with pytest.warns(UserWarning, match=f"file://{photos}/clear.webp: transparent pixels"):
        eg.load_image(f"file://{photos}/clear.webp")
    (photos / "clear.webp").unlink()


def test_images_of_a_basis_and_a_model(place, photos, tmp_path):
    folder = item(place, "").rstrip("/") if "{}" not in place else place.format("*.png")
    basis = eg.Eigenbasis.from_images(folder, size=(32, 32), components=2)
    assert basis.count == 4
    each = [item(place, f"{k}.png") for k in range(4)]
    again = eg.Eigenbasis.from_images(each, size=(32, 32), components=2)
    np.testing.assert_array_equal(again.mean, basis.mean)
    model = eg.EigenGS.fit(basis, gaussians=60)
    assert model.encode(each[0]).width == 32
    assert [len(basis.project(each[0])[0])] == [2]
    result = eg.fit(each[0], start=model, iterations=0)
    np.testing.assert_allclose(result.image, eg.picture_of(model.encode(each[0])), atol=1e-4)


@few_groups()
def test_commands_take_urls(photos, tmp_path):
    url, out = f"file://{photos}/3.png", tmp_path / "a.npz"
    few = ("--size", "16x16", "--gaussians", 50, "--components", 2)
    for command in (
        ("fit", url, "-o", out, "--iterations", 5),
        ("view", out, "--image", url, "-o", tmp_path / "a.html"),
        ("pack", out, "--image", url, "-o", tmp_path / "a.egs"),
        ("fit", "--map", f"albedo={url}", "-o", tmp_path / "m.npz", "--iterations", 5),
        ("train", f"file://{photos}", *few, "-o", tmp_path / "model.npz"),
    ):
        succeeded(run(*command))
    missing = run("fit", f"file://{photos}/none.png", "-o", tmp_path / "none.npz")
    assert_refused(missing, "none.png: cannot be read")


def test_an_output_that_is_a_url_is_refused(photos):
    model, result = small_model("llvm"), eg.fit(photos / "0.png", gaussians=20, iterations=0)
    for write, url in (
        (result.save, "memory://out/a.npz"),
        (model.save, "s3://bucket/x.npz"),
        (lambda url: eg.save_image(url, result.image), "memory://out/a.png"),
        (lambda url: eg.pack(result, url), "memory://out/a.egs"),
        (lambda url: eg.fit_large(result.image, url), "memory://out/a.npz"),
        (lambda url: eg.fit_many(photos, url), "memory://fits"),
        (lambda url: model.encode_many(photos, url), "memory://fits"),
    ):
        with pytest.raises(OSError, match=f"{url}: .*cannot be written to URLs"):
            write(url)


@few_groups()
def test_a_fit_works_where_a_set_does(photos, tmp_path):
    result = eg.fit(photos / "0.png", **QUICK)
    want = eg.render(result.gaussians).numpy()
    np.testing.assert_array_equal(eg.render(result).numpy(), want)
    np.testing.assert_array_equal(eg.picture_of(result), eg.picture_of(result.gaussians))
    result.save(tmp_path / "a.npz")
    np.testing.assert_array_equal(eg.render(eg.Gaussians.load(tmp_path / "a.npz")).numpy(), want)
    assert (
        eg.pack(result, tmp_path / "a.egs").bytes
        == eg.pack(result.gaussians, tmp_path / "b.egs").bytes
    )
    assert "Gaussians" in eg.view(result).html
    with pytest.raises(TypeError, match="ndarray is not a set of Gaussians; pass Gaussians"):
        eg.render(result.image)
    pixels = eg.load_image(photos / "0.png")
    assert result.psnr_rgb == pytest.approx(eg.psnr(pixels, result.image, space="rgb"), abs=1e-4)


def test_a_texture_of_a_fit(photos):
    pytest.importorskip("mitsuba")
    from eigengs_dr.plugins import texture_of

    result = eg.fit(photos / "0.png", gaussians=20, iterations=0)
    assert texture_of(result)["width"] == 32
