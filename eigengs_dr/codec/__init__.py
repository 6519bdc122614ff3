"""Sets of Gaussians in few bytes."""
