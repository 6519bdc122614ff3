"""The principal components of a family of images.

- ``basis``: the result, `Eigenbasis`
- ``accumulate``: all images of a source, by one of ``solvers``
- ``component_counts``: how many components are allowed, and how many an energy needs
- ``lazy_images``: images of an array that is computed part by part
- ``truncation``: the error against the number of components
- ``basis_file``: the file of a basis
"""
