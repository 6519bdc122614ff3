"""The set of Gaussians: its maps, covariances, tensors and files.

- ``gaussians``: the set, its bounds, its tensors; the union of several sets
- ``covariance``: factors, Cholesky factors, eigenvalues
- ``channels``: groups of channels with a name and a space
- ``file``: the files of a set, .npz and .egs, and its checks
- ``region``: the part of a set inside a region
"""
