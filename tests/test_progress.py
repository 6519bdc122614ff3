"""Bars that a function shows by itself, lines above them, and pictures of maps."""

import io
import sys
import time
from contextlib import redirect_stderr
from types import SimpleNamespace

import pytest

import eigengs_dr as eg
from eigengs_dr.backend import doors
from eigengs_dr.cli import console

QUICK = {"gaussians": 30, "iterations": 10}


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture(scope="module")
def photo():
    return eg.sample("coffee")[:32, :32]


@pytest.fixture
def at_once(monkeypatch):
    """Bars appear at once."""
    monkeypatch.setattr(doors, "DELAY", 0.0)


@doors.shows_progress
def slow(steps, progress=None):
    for step in range(steps):
        time.sleep(0.05)
        if progress:
            progress(step + 1, steps, {"psnr_rgb": 30.0})


def test_a_bar_waits(photo):
    with redirect_stderr(Terminal()):
        slow(3)
        assert sys.stderr.getvalue().strip() == ""


def test_no_bar_where_it_is_switched_off_or_nobody_looks(at_once, photo):
    for stream, progress in ((Terminal(), False), (io.StringIO(), None)):
        with redirect_stderr(stream):
            slow(3, progress=progress)
            eg.fit(photo, progress=progress, **QUICK)
        assert stream.getvalue() == ""


@pytest.mark.parametrize("progress", [5, "yes", 0])
def test_what_is_no_progress(photo, progress):
    with pytest.raises(TypeError, match=rf"progress is {progress!r}; pass True, False or a fun"):
        eg.fit(photo, progress=progress, **QUICK)


class Closed(io.StringIO):
    def isatty(self):
        raise ValueError("I/O operation on closed file")


@pytest.mark.parametrize("stream", [None, Closed(), SimpleNamespace(write=print, flush=print)])
@pytest.mark.parametrize("progress", [None, True])
def test_no_bar_without_a_stream(photo, monkeypatch, stream, progress):
    """As in a service, or where standard error was closed or replaced."""
    monkeypatch.setattr(sys, "stderr", stream)
    assert len(eg.fit(photo, progress=progress, **QUICK).gaussians) == 30


@pytest.mark.parametrize("progress", [None, True, "call"])
def test_every_long_function_takes_a_bar_or_a_function(progress, at_once, photo):
    calls = []
    if progress == "call":
        progress = lambda *row: calls.append(row)  # noqa: E731
    with redirect_stderr(Terminal()) as terminal:
        slow(3, progress=progress)
        eg.fit(photo, progress=progress, **QUICK)
        eg.fit_many([photo], progress=progress, **QUICK)
        eg.fit(photo, progress=progress, **{**QUICK, "gaussians": [5, 20]})
        eg.fit({"albedo": photo}, progress=progress, **QUICK)
        basis = eg.Eigenbasis.from_images([photo] * 3, (32, 32), 1, progress=progress)
        model = eg.EigenGS.fit(basis, gaussians=30, progress=progress)
        model.encode_many([photo], progress=progress)
    assert bool(calls) == callable(progress)
    names = ("slow", "30.00 dB", "fit:", "fit_many:", "from_images:")
    assert callable(progress) or all(name in terminal.getvalue() for name in names)


def test_a_bar_is_called_by_the_image_and_the_stage(at_once):
    @doors.shows_progress
    def convert(progress=None):
        progress(0, 1, {"stage": "scene"})
        for step in range(4):
            progress(step, 4, {"image": "1/1 photo.png", "stage": "search", "psnr_rgb": 30.0})
            time.sleep(0.05)
        progress(1, 2, {"stage": "renderings"})
        time.sleep(0.2)
        progress(2, 2, {"stage": "renderings"})

    with redirect_stderr(Terminal()) as terminal:
        convert()
    shown = terminal.getvalue().replace("\r", "\n")
    assert "1/1 photo.png: search: " in shown and "30.00 dB" in shown
    last = [line for line in shown.splitlines() if line.startswith("renderings: ")][-1]
    assert "2/2" in last and "dB" not in last  # each stage has its own figures


def test_a_line_stands_above_the_bar_of_a_command(at_once):
    with redirect_stderr(Terminal()) as terminal, console.bar(False) as show:
        show("photos", 3, 4, {"psnr_rgb": 31.2})
        console.print_message("error: x.png: no image")
    assert "photos" in terminal.getvalue()
    assert "eigengs-dr: error: x.png: no image\n" in terminal.getvalue()


def test_materials_have_a_picture_of_each_map(photo):
    found = eg.fit({"albedo": photo, "roughness": photo[..., 0]}, **QUICK)
    assert found._repr_html_().count("<img") == 2 and "roughness" in found._repr_html_()
    assert found.gaussians._repr_html_().count("<img") == 2
