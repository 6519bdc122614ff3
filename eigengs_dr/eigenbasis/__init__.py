"""Families of images: one set of Gaussians for all principal components.

- ``basis``: the principal components, `Eigenbasis`
- ``incremental``: merging a block of images, or another state, into a state; all images in shards
- ``truncation``: the error as a function of the number of components
- ``components``: from an eigenbasis to shared Gaussians and their weights in all components
- ``normal_equations``: the best colours of many images on the same shapes
- ``eigengs``: the model `EigenGS`
- ``encoder``: from an image to Gaussians of the model, or to coefficients
- ``training``: from a folder of images to a model, with figures of held-out images
- ``files``: the files of a basis and of a model
"""
