"""Gradient descent.

- ``schedule``: rates, their decay, and the registries
- ``parameterization``: the variables that an optimiser moves
- ``moments``: the interface of optimisers, and moving averages
- ``adam``: Adam
- ``adan``: Adan
- ``state``: what a step changes
- ``descent``: the steps
"""
