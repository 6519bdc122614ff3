"""The methods of the papers, and the parts that only they need.

- ``eigengs``: EigenGS (Tai et al., CVPR 2025): the method `EIGENGS`
- ``joint_training``: the training of shapes and weights in EigenGS
- ``gaussianimage``: GaussianImage (Zhang et al., ECCV 2024): the method `GAUSSIANIMAGE`
- ``cholesky``: the variables of both
- ``adan``: the optimiser of both
- ``placement``: their initialization by random Gaussians
"""
