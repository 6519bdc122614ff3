"""Where Gaussians start, and where they are added.

- ``adaptive``: placement by second derivatives of the image; redistribution by the error of a fit
- ``filters``: blurs and second derivatives of images in tile layout
- ``pieces``: centres of equal mass of a density
- ``density``: the density for an error
- ``peaks``: where an added Gaussian would reduce a residual most
"""
