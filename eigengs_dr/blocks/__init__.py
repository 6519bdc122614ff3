"""Large images: fitted by blocks and rendered by bands, in the memory of one block.

- ``windows``: windows of files and arrays; large TIFF files
- ``grid``: blocks, their windows, their numbers of Gaussians, and the Gaussians of all blocks
- ``block``: the placement and the fit of one block, and the rounds of exchange
- ``run``: the stages of a fit of all blocks
- ``fit_large``: `fit_large`, the fit of all blocks
- ``draw``: rendering of regions by bands, and their PSNR
"""
