"""Many images, one row of results for each: read ahead, worked on in groups, written whole.

- ``plan``: a run: its images, its manifest, and where its work is done
- ``sources``, ``remote``: names and outputs of the images; images behind URLs
- ``manifest``: the rows of a folder, from which a run continues
- ``read_ahead``: images decoded by threads before they are needed, in bounded memory
- ``run``: the loop over groups of images in this process
- ``dispatch``: the same on the workers of a cluster, a chunk of images a task
- ``row``: what becomes of an image
- ``fit_batch``: the fit of several small images in one program
- ``fit_many``: `fit_many`, the fit of many images
"""
