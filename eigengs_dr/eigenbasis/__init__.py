"""Families of images: PCA, shared Gaussians for all components, models."""
