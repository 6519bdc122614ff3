"""The principal components of a family of images.

- ``incremental_pca``: one block of images at a time
- ``basis``: the result, `Eigenbasis`
- ``truncation``: the error against the number of components
- ``basis_file``: the file of a basis
"""
