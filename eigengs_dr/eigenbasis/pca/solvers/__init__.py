"""How the principal components are found.

- ``incremental_pca``: one block of images at a time; two states into one
- ``shards``: shards by many workers, merged in a fixed tree, ``shard_tree``
- ``gram``: the exact components, from the inner products of all pairs of images
- ``store_images``: the images of a source into a ``plane_store``, of which a part is read at a time
- ``parts``: parts of a source, which workers read
- ``eigenpairs``: the eigenvectors of a Gram matrix, and rows that stay orthonormal
"""
