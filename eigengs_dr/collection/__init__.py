"""Runs over many images: reading ahead, work on groups, atomic results, one row for each image.

- ``sources``: names, outputs and pixels of the images
- ``manifest``: the row of an image, and the rows of a folder
- ``run``: a run over groups of images in this process, or chunks of images on a cluster
- ``fit_many``: `fit_many`, the fit of many images
"""
