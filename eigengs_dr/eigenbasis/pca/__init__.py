"""The principal components of a family of images.

- ``incremental_pca``: one block of images at a time; two states into one
- ``accumulate``: all images of a source, in one stream or in shards
- ``shards``: shards by many workers, merged in a fixed tree
- ``lazy_images``: images of an array that is computed part by part
- ``basis``: the result, `Eigenbasis`
- ``truncation``: the error against the number of components
- ``basis_file``: the file of a basis
"""
