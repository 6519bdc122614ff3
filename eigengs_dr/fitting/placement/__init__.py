"""Where Gaussians start, and where they are added.

- ``adaptive``: placement by second derivatives of the image; redistribution by the error of a fit
- ``filters``: blurs and second derivatives of images in tile layout; peaks of a residual
- ``pieces``: centres of equal mass of a density
"""
