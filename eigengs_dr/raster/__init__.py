"""Rasterization: the weight of a Gaussian at a pixel, and the sum of all Gaussians."""
