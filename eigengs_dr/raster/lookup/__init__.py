"""The sum at scattered points and through footprints, as textures need it."""
