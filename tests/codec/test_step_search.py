"""The search of the largest steps: near the limit, whatever the noise of the error."""

import math

import numpy as np
import pytest

from eigengs_dr.codec import step_search
from eigengs_dr.codec.step_search import Attempt, smallest_within


def rounding(crossing, noise=0.0, seed=0):
    """An attempt whose error crosses the limit somewhere, and whose files shrink with the steps."""
    tried = {}

    def attempt(octaves):
        assert octaves not in tried
        luck = np.random.default_rng((seed, round(octaves * 64) + 1024)).normal()
        excess = 4 ** (octaves - crossing) * math.exp(noise * luck)
        tried[octaves] = Attempt(excess, None, b"." * round(10_000 - 1_000 * octaves))
        return tried[octaves]

    return attempt, tried


@pytest.mark.parametrize("crossing", [-7.3, -0.5, -0.02, 0.0, 0.11, 0.26, 1.3, 3.99])
def test_without_noise_it_ends_at_the_limit(crossing):
    attempt, tried = rounding(crossing)
    best = smallest_within(attempt)
    octaves = next(k for k, found in tried.items() if found is best)
    assert crossing - 1 / 32 < octaves <= crossing + 1e-9
    assert len(tried) <= 13 + 2 * abs(crossing)


@pytest.mark.parametrize("noise", [0.02, 0.15, 0.5])
def test_with_noise_it_is_smaller_than_by_bisection(noise):
    """In the mean over many sets; and it never exceeds the limit."""
    saved = []
    for seed in range(60):
        attempt, tried = rounding(0.4 * math.sin(seed), noise, seed)
        best = smallest_within(attempt)
        assert best.excess <= 1
        assert len(best.content) == min(len(a.content) for a in tried.values() if a.excess <= 1)
        saved.append(len(bisected(rounding(0.4 * math.sin(seed), noise, seed)[0]).content))
        saved[-1] -= len(best.content)
    assert np.mean(saved) > 0


def bisected(attempt):
    """Four halvings of half an octave below or above the first factor."""
    octaves, best = 0.0, attempt(0.0)
    while best.excess > 1:
        octaves -= 0.5
        best = attempt(octaves)
    for k in range(1 if octaves == 0 else 2, 6):
        tried = attempt(octaves + 0.5**k)
        if tried.excess <= 1:
            octaves, best = octaves + 0.5**k, tried
    return best


def test_an_error_that_no_step_changes():
    assert smallest_within(lambda octaves: Attempt(1.5, None, b"")) is None
    attempts = []

    def free(octaves):
        attempts.append(octaves)
        return Attempt(0.0, None, b"")

    assert smallest_within(free) is not None
    assert 1 < max(attempts) <= step_search.MAX_OCTAVES
