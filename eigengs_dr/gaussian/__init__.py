"""The representation: sets of 2D Gaussians.

- ``gaussians``: the set
- ``bounds``: the bounds of its parameters
- ``concatenate``: joining sets; ``like``: other Gaussians for the same image
- ``covariance``: factors, Cholesky factors, logarithms, eigenvalues
- ``tensors``: sets as tensors
- ``file``: the .npz file, and what makes a set valid
"""
