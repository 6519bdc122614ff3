"""The sums of benchmarks are right: means, interpolations, fronts, and cells of tables."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from _helpers.benchmarks import lines_of, row
from eigengs_bench import inverse, pareto, rate, stability
from eigengs_bench.alike import psnr_without_noise


@given(st.lists(st.tuples(st.floats(0.1, 9), st.one_of(st.floats(0, 50), st.just(np.nan)))))
def test_front_is_what_nothing_beats(points):
    known = {p for p in points if p[1] == p[1]}
    beaten = {p for p in known for q in known if q != p and q[0] <= p[0] and q[1] >= p[1]}
    assert pareto.front(points) == sorted(known - beaten)


def test_the_matrix_of_ends():
    def cell(name, end, seed=0, finite=True):
        job = {"case": name, "preset": "default", "iterations": 9, "seed": seed}
        return row(job, finite=finite, start_ycbcr=30.0, end_ycbcr=end, seconds=seed + 1.0)

    made = [cell("better", 40.0), cell("exact", 100.0), cell("broken", None, finite=False)]
    made += [cell("seeds", end, seed) for seed, end in enumerate((40.0, 40.5, 41.0))]
    made.append(row(made[0]["job"] | {"case": "thin"}, needs="a larger image"))
    [ends] = stability.summarize(made).tables
    expected = {
        "better": "40.0 from 30.0",
        "exact": "exact from 30.0",
        "broken": "not finite",
        "thin": "needs a larger image",
        "seeds": "40.5 (40.00 to 41.00) from 30.0",
    }
    assert dict(lines_of(ends)) == expected


def curve(bits, decibels, image="a", codec="x"):
    points = {"bits_per_pixel": bits, "psnr_rgb": decibels, "image": image, "codec": codec}
    return pd.DataFrame(points)


def test_bd_rate_of_half_the_bits():
    bits, decibels = np.array([0.5, 1.0, 2.0, 4.0]), np.array([28.0, 31.0, 34.0, 37.0])
    found = rate.bd_rate(curve(bits / 2, decibels), curve(bits, decibels))
    assert found == pytest.approx(-0.5)
    assert np.isnan(rate.bd_rate(curve(bits, decibels), curve(bits, decibels + 90)))


def test_means_at_equal_slope_give_hard_images_more():
    """Of D(R) = c 4^-R the slope is proportional to D: all images end at one error."""
    bits = np.linspace(0.5, 8, 200)
    points = [
        curve(bits, 10 * np.log10(255**2 / (c * 4.0**-bits)), str(c)) for c in (1000.0, 16000.0)
    ]
    found = rate.at_equal_slope(pd.concat(points, ignore_index=True))
    error = 255**2 * 10 ** (-found.psnr_rgb / 10)
    expected = rate.SLOPES / np.log(4)
    inside = (expected < 400) & (expected > 20)
    np.testing.assert_allclose(error[inside[: len(error)]], expected[inside], rtol=0.05)


def test_a_psnr_without_noise():
    noise = np.random.default_rng(0).normal(0, 0.05, (2, 64, 32, 32, 3))
    pictures = noise + np.reshape([0.3, 0.32], (2, 1, 1, 1, 1))
    low, high = 1.055 * np.array([0.3, 0.32]) ** (1 / 2.4) - 0.055  # sRGB
    expected = -20 * np.log10(high - low)
    assert psnr_without_noise(pictures[1], pictures[0]) == pytest.approx(expected, abs=0.2)


def test_gain_at_equal_seconds():
    """Half-way in the logarithm of the seconds lies half the gain; the best rival counts."""
    pyramid = {k: {"seconds": s, "psnr_rgb": p} for k, s, p in ((1, 1, 30), (2, 4, 40))}
    texels = {1: {"seconds": 6, "psnr_rgb": 35}}
    seconds = ((1, 2 / inverse.SLOWER), (2, 8), (3, 0.5))
    fits = {k: {"seconds": s, "psnr_rgb": 36} for k, s in seconds}
    assert inverse.gain({"pyramid": pyramid, "fit": fits}) == pytest.approx([1, -4, 6])
    both = {"pyramid": pyramid, "texels": texels, "fit": fits}
    assert inverse.gain(both) == pytest.approx([1, -4, 1])
    worse = {3: {"seconds": 8, "psnr_rgb": 30}}  # what a rival has reached is not lost
    assert inverse.gain({"pyramid": pyramid | worse, "fit": fits}) == pytest.approx([1, -4, 6])
