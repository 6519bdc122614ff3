"""Which Gaussians touch which tile.

- ``tiles``: the tiles of an image and of a Gaussian; how much work a lane gets
- ``lists``: the lists of an image, which kernels walk; their orders
"""
