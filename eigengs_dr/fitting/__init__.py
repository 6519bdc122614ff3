"""From an image to its Gaussians."""
