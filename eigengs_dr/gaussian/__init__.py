"""Sets of 2D Gaussians, their covariances and their files."""
