"""Which Gaussians touch which tile.

- ``tiles``: the tiles of an image and of a Gaussian; the amount of work of a lane
- ``lists``: the lists of an image, which kernels traverse, and the order of their lanes
"""
