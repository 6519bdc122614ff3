"""Bars that a function shows by itself, and what users read when they mistype."""

import io
import warnings
from contextlib import redirect_stderr
from dataclasses import replace
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.command import main
from _helpers.photos import coffee

QUICK = {"gaussians": 64, "iterations": 2}


class Terminal(io.StringIO):
    def isatty(self):
        return True


class Closed(io.StringIO):
    def isatty(self):
        raise ValueError("I/O operation on closed file")


@pytest.fixture(scope="module")
def photo():
    return coffee(32)


@pytest.fixture(scope="module")
def gaussians(photo):
    return eg.fit(photo, 64, iterations=0).gaussians


@pytest.fixture
def hours(monkeypatch):
    """A clock that goes on by 3 seconds whenever a bar looks at it."""
    monkeypatch.setattr("tqdm.std.time", count(0, 3).__next__)


def test_a_bar_waits_for_two_seconds(photo):
    with redirect_stderr(Terminal()) as terminal:
        eg.fit(photo, **QUICK)
    assert terminal.getvalue().strip() == ""


@pytest.mark.parametrize("progress", [5, "yes", 0])
def test_what_is_no_progress(photo, progress):
    with pytest.raises(TypeError, match=rf"progress is {progress!r}; pass True, False or a fun"):
        eg.fit(photo, progress=progress, **QUICK)


@pytest.mark.parametrize("stream", [None, Closed(), SimpleNamespace(write=print, flush=print)])
@pytest.mark.parametrize("progress", [None, True])
def test_no_bar_without_a_stream(photo, stream, progress):
    """As in a service, or where standard error was closed or replaced."""
    with redirect_stderr(stream):
        assert len(eg.fit(photo, progress=progress, **QUICK).gaussians) == 64


@pytest.mark.parametrize("progress", [None, True, "call"])
def test_every_long_function_takes_a_bar_or_a_function(progress, hours, photo):
    calls = []

    def called(*row):
        calls.append(row)

    progress = called if progress == "call" else progress
    with redirect_stderr(Terminal()) as terminal:
        eg.fit(photo, progress=progress, **QUICK)
        eg.fit_many([photo], progress=progress, **QUICK)
        basis = eg.Eigenbasis.from_images([photo] * 3, (32, 32), 1, progress=progress)
        model = eg.EigenGS.fit(basis, gaussians=64, progress=progress)
        model.encode_many([photo], progress=progress)
    assert bool(calls) == callable(progress)
    names = ("fit:", " dB", "fit_many:", "from_images:", "encode_many:")
    assert callable(progress) or all(name in terminal.getvalue() for name in names)


@pytest.mark.parametrize(("stream", "progress"), [(Terminal, False), (io.StringIO, None)])
def test_no_bar_where_it_is_switched_off_or_nobody_looks(hours, photo, stream, progress):
    with redirect_stderr(stream()) as shown:
        eg.fit(photo, progress=progress, **QUICK)
    assert shown.getvalue() == ""


def test_a_line_stands_above_the_bar_of_a_command(hours, photo, tmp_path):
    eg.save_image(tmp_path / "a.png", photo)
    (tmp_path / "b.png").write_text("no image")
    words = ["fit", str(tmp_path), "-o", str(tmp_path / "fits"), "--iterations", "1"]
    with redirect_stderr(Terminal()) as terminal, pytest.raises(SystemExit):
        main(words)
    lines = terminal.getvalue().replace("\r", "\n").splitlines()
    assert any(line.startswith("fits: ") and "|" in line for line in lines)
    assert [line for line in lines if line.startswith("eigengs-dr: error: ") and "b.png" in line]


# --- Mistyped names, and other values ---


@pytest.mark.parametrize("name", ["fit", "fit_many", "fit_large"])
def test_a_mistyped_option_says_the_right_one(name, photo):
    text = "^unknown option 'itertions'; did you mean 'iterations'\\?$"
    with pytest.raises(TypeError, match=text):
        getattr(eg, name)(photo, itertions=5)
    with pytest.raises(TypeError, match=r"unknown option 'zzz'; use one of .*iterations"):
        getattr(eg, name)(photo, zzz=5)


def test_mistaken_arguments_name_the_function(gaussians):
    with pytest.raises(TypeError, match=r"^render\(\) got an unexpected keyword argument 'scale'$"):
        eg.render(gaussians, scale=2)
    with pytest.raises(TypeError, match=r"^pack\(\) missing a required argument: 'output'$"):
        eg.pack(gaussians)


def test_arrays_of_other_shapes_are_refused_by_name(gaussians):
    with pytest.raises(ValueError, match=r"mean has shape \(7, 2\), expected \(64, 2\)"):
        eg.render(replace(gaussians, mean=gaussians[:7].mean))
    with pytest.raises(ValueError, match=r"mean has shape \(64, 3\), expected \(64, 2\)"):
        eg.render(replace(gaussians, mean=gaussians.factor))


def test_warnings_point_at_the_line_of_the_user(photo, tmp_path):
    Image.fromarray(np.zeros((32, 32, 4), np.uint8)).save(tmp_path / "a.png")
    (tmp_path / "photos").mkdir()
    eg.save_image(tmp_path / "photos" / "b.png", photo)
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        eg.load_image(tmp_path / "a.png")
        eg.fit(tmp_path / "a.png", **QUICK)
        eg.Eigenbasis.from_images(tmp_path / "photos", size=(16, 16), components=3)
    assert len(shown) >= 4
    assert {warning.filename for warning in shown} == {__file__}
