"""Shared Gaussians for all components of an eigenbasis.

- ``solve``: shapes, then the weights of all Gaussians in all components
- ``weights``: the weights of given Gaussians, group by group, here or by workers
- ``split``: the frequency-aware split
- ``shape_training``: training of shapes by random combinations of components
- ``joint_training``: training of shapes and weights together, as the paper does
- ``joint_state``: the state of that training
"""
