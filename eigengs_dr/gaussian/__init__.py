"""The representation: sets of 2D Gaussians.

- ``gaussians``: the set
- ``concatenate``: joining sets
- ``covariance``: factors, Cholesky factors, logarithms, eigenvalues
- ``tensors``: sets as tensors
- ``file``: the .npz file, and what makes a set valid
"""
