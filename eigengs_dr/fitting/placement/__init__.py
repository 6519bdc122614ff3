"""Placement: where Gaussians start, and where density control adds them. NumPy only."""
