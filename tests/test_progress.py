"""Bars that a function shows by itself, and pictures of materials and packed sets."""

import io
import sys
import time

import pytest

import eigengs_dr as eg
from eigengs_dr.backend import feedback as display

QUICK = {"gaussians": 30, "iterations": 10}


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture(scope="module")
def photo():
    return eg.sample("coffee")[:32, :32]


def open_terminal(monkeypatch):
    """Replace standard error, within a test: pytest sets it anew before each."""
    monkeypatch.setattr(sys, "stderr", Terminal())
    return sys.stderr


@display.shows_progress
def slow(steps, progress=None):
    for step in range(steps):
        time.sleep(0.05)
        if progress:
            progress(step + 1, steps, {"psnr_rgb": 30.0})


def test_a_terminal_shows_a_bar_after_the_delay(monkeypatch):
    terminal = open_terminal(monkeypatch)
    slow(3)
    assert terminal.getvalue().strip() == ""
    monkeypatch.setattr(display, "DELAY", 0.1)
    slow(10)
    assert "slow" in terminal.getvalue() and "30.00 dB" in terminal.getvalue()


def test_no_bar_where_it_is_switched_off_or_nobody_looks(monkeypatch, photo):
    terminal = open_terminal(monkeypatch)
    monkeypatch.setattr(display, "DELAY", 0.0)
    slow(3, progress=False)
    eg.fit(photo, progress=False, **QUICK)
    assert terminal.getvalue() == ""
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    slow(3)
    eg.fit(photo, **QUICK)
    assert sys.stderr.getvalue() == ""


@pytest.mark.parametrize("progress", [None, True, "call"])
def test_every_long_function_takes_a_bar_or_a_function(progress, monkeypatch, photo):
    terminal = open_terminal(monkeypatch)
    monkeypatch.setattr(display, "DELAY", 0.0)
    calls = []
    if progress == "call":
        progress = lambda *row: calls.append(row)  # noqa: E731
    eg.fit(photo, progress=progress, **QUICK)
    eg.fit_many([photo], progress=progress, **QUICK)
    eg.fit(photo, levels=2, progress=progress, **QUICK)
    eg.fit({"albedo": photo}, progress=progress, **QUICK)
    basis = eg.Eigenbasis.from_images([photo] * 3, size=(32, 32), components=1, progress=progress)
    model = eg.EigenGS.fit(basis, gaussians=30, progress=progress)
    model.encode_many([photo], progress=progress)
    assert bool(calls) == callable(progress)
    names = ("fit", "fit_many", "from_images")
    assert callable(progress) or all(f"{name}:" in terminal.getvalue() for name in names)


def test_materials_and_packed_sets_have_pictures(photo, tmp_path):
    found = eg.fit({"albedo": photo, "roughness": photo[..., 0]}, **QUICK)
    assert found._repr_html_().count("<img") == 2 and "roughness" in found._repr_html_()
    assert found.gaussians._repr_html_().count("<img") == 2
    packed = eg.pack(found.gaussians, tmp_path / "m.egs")
    assert packed._repr_html_().count("<img") == 2
    result = eg.fit(photo, **QUICK)
    assert eg.pack(result, tmp_path / "a.egs")._repr_html_().count("<img") == 1
