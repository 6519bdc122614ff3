"""Compression of sets of Gaussians to ``.egs`` files."""
