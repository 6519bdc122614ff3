"""Where Gaussians start, and where they are added; NumPy only.

- ``uniform``: on a hexagonal grid, and at random
- ``adaptive``: by the second derivatives of the image
- ``density``: the density that an error asks for
- ``peaks``: the peaks of a residual
"""
