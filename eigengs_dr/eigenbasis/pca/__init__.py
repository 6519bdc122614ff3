"""The principal components of a family of images."""
