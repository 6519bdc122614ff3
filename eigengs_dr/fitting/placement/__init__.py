"""Where Gaussians start and where they are added. NumPy only."""
