"""Many images, one row of results for each: read ahead, worked on in groups, written whole.

- ``sources``: names and outputs of the images
- ``read_ahead``: images decoded by threads before they are needed, in bounded memory
- ``run``: the loop over groups of images, with a row for each image
- ``fit_batch``: the fit of several small images in one program
- ``fit_many``: `fit_many`, the fit of many images
"""
