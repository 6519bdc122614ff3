"""The principal components of a family of images.

- ``incremental``: one block of images, or another state, into a state
- ``stream``: all images of a source, in shards by workers
- ``basis``: the result, `Eigenbasis`, and how many components it has
- ``truncation``: the error against the number of components
- ``basis_file``: the file of a basis
"""
