"""The search of the largest steps: near the limit, whatever the noise of the error."""

import math

import numpy as np
import pytest

from eigengs_dr.codec import step_search
from eigengs_dr.codec.step_search import Attempt, largest_within


def rounding(crossing, noise=0.0, seed=0):
    """An attempt whose error crosses the limit somewhere, and what was tried."""
    tried = {}

    def attempt(octaves):
        assert octaves not in tried
        luck = np.random.default_rng((seed, round(octaves * 64) + 1024)).normal()
        excess = 4 ** (octaves - crossing) * math.exp(noise * luck)
        tried[octaves] = Attempt(excess, None)
        return tried[octaves]

    return attempt, tried


@pytest.mark.parametrize("crossing", [-7.3, -0.5, -0.02, 0.0, 0.11, 0.26, 1.3, 3.99])
def test_without_noise_it_ends_at_the_limit(crossing):
    attempt, tried = rounding(crossing)
    best = largest_within(attempt)
    octaves = place(best, tried)
    assert crossing - 1 / 32 < octaves <= crossing + 1e-9
    assert len(tried) <= 13 + 2 * abs(crossing)


@pytest.mark.parametrize("noise", [0.02, 0.15, 0.5])
def test_with_noise_it_beats_bisection(noise):
    """In the mean over many sets; and it never exceeds the limit."""
    gained = []
    for seed in range(60):
        crossing = 0.4 * math.sin(seed)
        attempt, tried = rounding(crossing, noise, seed)
        best = largest_within(attempt)
        assert best.excess <= 1
        assert place(best, tried) == max(k for k, found in tried.items() if found.excess <= 1)
        gained.append(place(best, tried) - bisected(rounding(crossing, noise, seed)[0]))
    assert np.mean(gained) > 0


def place(best, tried):
    return next(octaves for octaves, found in tried.items() if found is best)


def bisected(attempt):
    """Four halvings of half an octave above the first factor, or one below, within the limit."""
    octaves = 0.0
    while attempt(octaves).excess > 1:
        octaves -= 0.5
    for k in range(1 if octaves == 0 else 2, 6):
        if attempt(octaves + 0.5**k).excess <= 1:
            octaves += 0.5**k
    return octaves


def test_an_error_that_no_step_changes():
    assert largest_within(lambda octaves: Attempt(1.5, None)) is None
    attempts = []

    def free(octaves):
        attempts.append(octaves)
        return Attempt(0.0, None)

    assert largest_within(free) is not None
    assert 1 < max(attempts) <= step_search.MAX_OCTAVES
