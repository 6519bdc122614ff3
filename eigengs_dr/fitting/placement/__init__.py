"""Where Gaussians start, and where they are added.

- ``adaptive``: by the second derivatives of the image; anew, by the error of a fit
- ``filters``: blurs and second derivatives of images in tile layout
- ``pieces``: centres of equal mass of a density
- ``density``: the density that an error asks for
- ``peaks``: where an added Gaussian would reduce a residual most
"""
