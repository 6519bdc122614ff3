"""Images: files, pixels, spaces of colour, metrics. This folder knows no Gaussians.

- ``io``: image files, and photos of scikit-image
- ``formats``: who reads and writes which files
- ``read``: headers and pixels of files, by OpenImageIO and Pillow; windows of large files
- ``notes``: warnings about what is not applied, such as colour profiles
- ``pixels``: the encoding of pixels, sRGB or linear light, the checks of an image, its strips
- ``folder``: many images, in blocks
- ``color``: colour spaces: YCbCr, linear light, sRGB, encodings of light above 1, normals
- ``resize``: resampling
- ``sheet``: contact sheets: pictures side by side, with text
- ``metrics``: PSNR, SSIM, MS-SSIM
- ``structure``: differentiable SSIM of tensors
"""
