"""Shared Gaussians for all components of an eigenbasis.

- ``solve``: shapes, then the weights of all Gaussians in all components; the split
- ``shape_training``: training of shapes by random combinations of components
- ``joint_training``: training of shapes and weights together, as the paper does
"""
