"""The sum at scattered points and through footprints, as textures need it.

- ``points``: values and slopes at points
- ``footprint``: the footprint of a pixel
- ``prefilter``: the sum seen through a footprint, in closed form
- ``size_classes``: the Gaussians that a footprint may see
- ``widened``: the Gaussians that a footprint widens
- ``pyramid``: wide footprints: coarse samples of the sum
- ``coarsen``: the samples of a pyramid
"""
