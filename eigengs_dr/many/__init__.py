"""Runs over pieces: many images, and the blocks of a large one, here or on workers.

- ``run``: the run over pieces; groups of images in this process, chunks of images on a cluster
- ``images``: the images of a run, a row for each, and what results say of an earlier run
- ``fit_many``: `fit_many`, the fit of many images
- ``fit_large``: `fit_large`, the fit of all blocks of an image, stage by stage
- ``block``: the placement and the fit of one block, and the rounds of exchange
- ``grid``: blocks, their windows, their numbers of Gaussians, and the Gaussians of all blocks
- ``windows``: windows of files and arrays; large TIFF files
- ``draw``: rendering of regions by bands, and their PSNR
"""
