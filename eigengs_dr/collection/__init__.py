"""Many images, one row of results for each: read ahead, worked on in groups, written whole.

- ``sources``: names, outputs and pixels of the images
- ``manifest``: what becomes of an image; the rows of a folder
- ``run``: a whole run, over groups of images in this process or chunks of images on a cluster
- ``fit_batch``: the fit of several small images in one program
- ``fit_many``: `fit_many`, the fit of many images
"""
