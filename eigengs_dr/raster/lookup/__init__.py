"""The sum of Gaussians at scattered points, for textures.

- ``cells``: lists of the Gaussians near each cell of an image
- ``points``: the sum at points, over the lists of cells
- ``footprint``: the footprint of a pixel, and Gaussians that it widens
- ``size_classes``: lists for footprints of several sizes
- ``prefilter``: the sum over a footprint
- ``pyramid``: coarser sums for wide footprints, and their construction
"""
