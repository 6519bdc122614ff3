"""The sum of Gaussians at scattered points and through footprints, for textures."""
