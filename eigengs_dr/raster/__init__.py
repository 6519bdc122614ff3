"""What a Gaussian contributes to a pixel, and the sum of all Gaussians.

- ``evaluate``: the weight of one Gaussian at a block of pixels, and its derivatives
- ``parameters``: Gaussians in the units of the kernels
- ``layout``: where parameters lie in memory
- ``limits``: sizes that 32-bit indices can number
- ``binning``: which Gaussians touch which tile
- ``kernels``: the sum over all Gaussians and its error
- ``adjoint``: its gradient
- ``rows``: images from tile layout to rows of pixels
- ``render``: the differentiable operation and `render`
- ``picture``: the picture of a set, by strips of rows
- ``reference``: slow renderers to compare with
- ``lookup``: the sum at scattered points, for textures
"""
