"""The principal components of a family of images.

- ``incremental``: merging a block of images, or another state, into a state
- ``stream``: all images of a source, in shards on workers
- ``basis``: the result, `Eigenbasis`, and its number of components
- ``truncation``: the error as a function of the number of components
- ``basis_file``: the file of a basis
"""
