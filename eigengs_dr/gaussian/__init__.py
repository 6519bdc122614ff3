"""The set of Gaussians: its maps, covariances, tensors and files.

- ``gaussians``: the set, its bounds, its tensors; the union of several sets
- ``covariance``: factors, Cholesky factors, logarithms, eigenvalues
- ``channels``: groups of channels with a name and a space
- ``file``: the .npz file, and the checks of a set
- ``packed``: the .egs file, which the codec reads
- ``region``: the part of a set inside a region
"""
