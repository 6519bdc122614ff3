"""What a Gaussian contributes to a pixel, and the sum; at scattered points too.

- ``evaluate``: the weight of one Gaussian at a block of pixels, and its derivatives
- ``parameters``: Gaussians in the units of the kernels, and their layout in memory
- ``tiles``: the tiles of an image and of a Gaussian; the amount of work of a lane
- ``lists``: which Gaussians touch which tile, and the order of lanes
- ``kernels``: the sum over all Gaussians, and its error against a target
- ``adjoint``: the gradient of the sum
- ``render``: the differentiable operation, `render`, and tile layout
- ``lookup``: the sum at scattered points, for textures
"""
