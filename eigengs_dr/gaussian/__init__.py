"""The set of Gaussians: its maps, covariances, tensors and files.

- ``gaussians``: the set, its bounds, its tensors; the union of several sets
- ``covariance``: factors, Cholesky factors, eigenvalues
- ``channels``: groups of channels with a name and a space
- ``file``: the arrays of a set, their checks, the part in a region, and the files .npz and .egs
"""
