"""What a Gaussian contributes to a pixel, and the sum of all Gaussians."""
