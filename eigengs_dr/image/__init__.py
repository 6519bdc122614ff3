"""Pixels: no Gaussians here.

- ``io``: image files; ``formats``: those that Pillow does not keep
- ``pixels``: what pixels are, sRGB or light, and the checks of an image
- ``samples``: photos of scikit-image
- ``folder``: many images, in blocks; ``planes``: their size and channels
- ``color``: YCbCr, linear light, sRGB
- ``radiance``: codes of light above 1
- ``resize``: other sizes
- ``metrics``: PSNR, SSIM, MS-SSIM; ``structure``: the sums of the last two
- ``montage``: pictures side by side
"""
