"""Where Gaussians start, and where they are added.

- ``random``: uniform, as GaussianImage does
- ``grid``: a hexagonal grid
- ``adaptive``: by the second derivatives of the image
- ``density``: the density that an error asks for
- ``peaks``: the peaks of a residual
- ``nearest``: the centre nearest to each pixel
"""
