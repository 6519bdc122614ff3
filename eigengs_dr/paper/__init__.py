"""The methods of the papers, and the parts that only they need.

- ``gaussianimage``: GaussianImage (Zhang et al., ECCV 2024): the method `GAUSSIANIMAGE`
- ``eigengs``: EigenGS (Tai et al., CVPR 2025): the method `EIGENGS`
- ``joint_training``: the training of shapes and weights in EigenGS
- ``adan``: the optimiser of both
"""
