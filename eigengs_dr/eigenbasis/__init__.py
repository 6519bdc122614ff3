"""Families of images: one set of Gaussians for all principal components.

- ``pca``: the principal components
- ``components``: from an eigenbasis to shared Gaussians and their weights in all components
- ``eigengs``: the model `EigenGS`
- ``encoder``: from an image to Gaussians of the model, or to coefficients
- ``normal_equations``: the best colours of many images on the same shapes
- ``options``: the options of a training
- ``training``: from a folder of images to a model, with figures of held-out images
- ``model_file``: the file of a model
"""
