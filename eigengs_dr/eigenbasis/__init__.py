"""A family of images: one set of Gaussians for all of its principal components.

- ``pca``: the principal components
- ``components``: an eigenbasis to a model: shared Gaussians, and their weights in all components
- ``eigengs``: the model `EigenGS`
- ``encoder``: an image to Gaussians of the model, or to coefficients
- ``options``: the options of a training
- ``training``: a folder of images to a model, and its figures on images held out
- ``model_file``: the file of a model
"""
