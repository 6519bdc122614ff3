"""The representation: sets of 2D Gaussians.

- ``gaussians``: the set, its bounds, its tensors; several sets as one
- ``covariance``: factors, Cholesky factors, logarithms, eigenvalues
- ``channels``: groups of channels with a name and a space
- ``file``: the .npz file, and what makes a set valid
- ``packed``: the .egs file, which the codec reads
- ``region``: the part of a set that a region shows
"""
