"""Pixels: files, colour spaces, sizes, metrics. No Gaussians."""
