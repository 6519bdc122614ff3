"""Pixels: no Gaussians here.

- ``io``: image files
- ``samples``: photos of scikit-image
- ``folder``: many images, in blocks
- ``color``: YCbCr, linear light, sRGB
- ``resize``: other sizes
- ``metrics``: PSNR, SSIM, MS-SSIM
- ``montage``: pictures side by side
"""
