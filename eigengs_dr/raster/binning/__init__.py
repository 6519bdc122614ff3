"""Which Gaussians touch which tile.

- ``tiles``: the tiles of an image and of a Gaussian; how much work a lane gets
- ``order``: the Gaussians by tile; lanes of like work side by side
- ``lists``: the lists of an image, which kernels walk
"""
