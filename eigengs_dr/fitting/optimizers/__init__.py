"""Gradient descent.

- ``schedule``: rates, their decay, and the registries
- ``parameterization``: the variables that an optimiser moves
- ``adam``: Adam
- ``adan``: Adan
- ``descent``: the steps
"""
