"""Linear least squares for the colours on fixed shapes.

- ``conjugate_gradient``: for one image, or a batch
- ``normal_equations``: for many images on the same shapes: factorised once
"""
