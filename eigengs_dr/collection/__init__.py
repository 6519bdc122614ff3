"""Many images, one row of results for each: read ahead, worked on in groups, written whole.

- ``sources``: names and outputs of the images; images decoded before they are needed
- ``manifest``: what becomes of an image; the rows of a folder, from which a run continues
- ``run``: the loop over groups of images in this process
- ``dispatch``: the same on the workers of a cluster, a chunk of images a task; a whole run
- ``fit_batch``: the fit of several small images in one program
- ``fit_many``: `fit_many`, the fit of many images
"""
