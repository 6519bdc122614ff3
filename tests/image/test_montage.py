"""Pictures beside each other, and lines of text."""

import numpy as np

from eigengs_dr.image.resize import join_pictures, text_line


def test_pictures_are_joined_on_white():
    joint = join_pictures([np.zeros((2, 3, 3)), np.zeros((4, 1, 3))], 1, gap=2)
    assert joint.shape == (4, 3 + 2 + 1 + 2, 3)
    black = joint.sum(axis=2) == 0
    assert black[:2, :3].all() and black[:, 5].all() and black.sum() == 10
    assert (joint[~black] == 1).all()


def test_a_line_holds_its_text():
    written = text_line("Agjpq", 200, 16)
    assert written.shape == (20, 200, 3)
    ink = np.argwhere(written.min(axis=2) < 0.5)
    assert ink.min() > 0 and ink[:, 0].max() < 19  # nothing is cut off below
    assert (text_line("", 200, 16) == 1).all()
