"""The representation: sets of 2D Gaussians, their covariances, their files."""
