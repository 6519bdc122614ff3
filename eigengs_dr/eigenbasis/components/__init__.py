"""Shared Gaussians for all components of an eigenbasis.

- ``bands``: the division of Gaussians and components into bands
- ``solve``: shapes, then the weights of all Gaussians in all components
"""
