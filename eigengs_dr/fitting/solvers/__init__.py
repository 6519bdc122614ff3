"""Linear least squares for the colours on fixed shapes.

- ``conjugate_gradient``: for one image, or a batch
- ``unknowns``: its vectors
- ``normal_equations``: for many images on the same shapes: factorised once
- ``weight_matrix``: the weights of all Gaussians as a sparse matrix
- ``block_inverse``: the inverse of the equations in dense blocks
"""
