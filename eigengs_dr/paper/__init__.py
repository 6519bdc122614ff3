"""The methods of the papers, and what only they need.

- ``eigengs``: EigenGS (Tai et al., CVPR 2025): the method `EIGENGS`
- ``joint_training``: its training of shapes and weights
- ``gaussianimage``: GaussianImage (Zhang et al., ECCV 2024): the method `GAUSSIANIMAGE`
- ``cholesky``: the variables of both
- ``adan``: the optimiser of both
- ``placement``: random Gaussians, their start
"""
