"""The search of the largest step: near the limit in few attempts, whatever the noise."""

import math

import numpy as np
import pytest

from eigengs_dr.codec import step_search
from eigengs_dr.codec.step_search import Attempt, largest_within


def rounding(crossing, noise=0.0, seed=0, first=0.0):
    """An attempt whose error crosses the limit somewhere, and what was tried."""
    tried = {}

    def attempt(octaves):
        luck = np.random.default_rng((seed, len(tried))).normal()
        excess = first + (1 - first) * 4 ** (octaves - crossing) * math.exp(noise * luck)
        tried[octaves] = excess
        return Attempt(excess, None)

    return attempt, tried


@pytest.mark.parametrize("first", [0.0, -3.0, 0.5])
@pytest.mark.parametrize("crossing", [-7.3, -0.5, -0.02, 0.0, 0.11, 1.3, 3.99])
def test_without_noise_it_ends_at_the_limit(crossing, first):
    attempt, tried = rounding(crossing, first=first)
    octaves, best = largest_within(attempt)
    assert crossing - 0.2 < octaves <= crossing + 1e-9
    assert best.excess == tried[octaves] >= step_search.FAIR
    assert len(tried) <= 7 + abs(crossing)


@pytest.mark.parametrize(("noise", "least"), [(0.02, 0.95), (0.15, 0.85), (0.5, 0.7)])
def test_with_noise_it_never_exceeds_the_limit(noise, least):
    used = []
    for seed in range(60):
        attempt, tried = rounding(0.4 * math.sin(seed), noise, seed)
        octaves, best = largest_within(attempt)
        assert best.excess == tried[octaves] <= 1
        assert octaves == max(k for k, excess in tried.items() if excess <= 1)
        assert len(tried) <= step_search.MAX_ATTEMPTS + 4
        used.append(best.excess)
    assert np.mean(used) > least


def test_an_error_that_no_step_changes():
    assert largest_within(lambda octaves: Attempt(1.5, None)) is None
    octaves, _ = largest_within(lambda octaves: Attempt(0.0, None))
    assert octaves == step_search.MAX_OCTAVES
