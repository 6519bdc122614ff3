"""Large images: fitted by blocks and drawn by strips, in the memory of one block.

- ``source``: windows of files and arrays
- ``grid``: blocks, their windows, and their shares of the Gaussians
- ``place``: where the Gaussians of a block start
- ``sets``: the Gaussians of all blocks
- ``block``: the fit of one block
- ``rounds``: the steps between which blocks exchange their Gaussians
- ``run``: the stages of a fit of all blocks
- ``fit_large``: `fit_large`, the fit of all blocks
- ``draw``: regions and strips of a picture, and their PSNR
- ``tiff``: large TIFF files
"""
