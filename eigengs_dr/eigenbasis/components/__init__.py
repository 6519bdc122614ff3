"""Shared Gaussians for all components of an eigenbasis.

- ``bands``: which Gaussians serve which components, all or one side of the split
- ``solve``: shapes, then the weights of all Gaussians in all components
- ``shape_training``: training of shapes by random combinations of components
- ``joint_training``: training of shapes and weights together, as the paper does
"""
