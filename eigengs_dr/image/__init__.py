"""Pixels: no Gaussians here.

- ``io``: image files, and photos of scikit-image
- ``formats``: the libraries that read and write a file
- ``remote``: images behind URLs
- ``pixels``: what pixels are, sRGB or light, and the checks of an image
- ``folder``: many images, in blocks
- ``color``: YCbCr, linear light, sRGB, codes of light above 1, normals, images of a family
- ``resize``: other sizes
- ``sheet``: pictures side by side, with text
- ``metrics``: PSNR, SSIM, MS-SSIM
- ``structure``: SSIM of tensors, with derivatives
- ``strips``: rows of an image by threads
- ``hilbert``: a curve through the cells of a square
"""
