"""What a Gaussian contributes to a pixel, and the sum of all Gaussians.

- ``evaluate``: the weight of one Gaussian at a block of pixels, and its derivatives
- ``parameters``: Gaussians in the units of the kernels, and where they lie in memory
- ``binning``: which Gaussians touch which tile
- ``kernels``: the sum over all Gaussians and its error
- ``adjoint``: its gradient
- ``render``: the differentiable operation, `render`, and the picture by strips of rows
- ``reference``: slow renderers to compare with
- ``lookup``: the sum at scattered points, for textures
"""
