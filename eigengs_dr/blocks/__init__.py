"""Large images: fitted by blocks and drawn by strips, in the memory of one block.

- ``windows``: windows of files and arrays; large TIFF files
- ``grid``: blocks, their windows, their shares of the Gaussians, and the Gaussians of all
- ``block``: the fit of one block, where its Gaussians start, and the rounds of exchange
- ``run``: the stages of a fit of all blocks
- ``fit_large``: `fit_large`, the fit of all blocks
- ``draw``: regions and strips of a picture, and their PSNR
"""
