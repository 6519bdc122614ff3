"""Images: files, pixels, colour spaces and metrics. This folder knows no Gaussians.

- ``io``: image files, and photos of scikit-image
- ``formats``: suffixes, and the libraries that write files
- ``header``, ``reading``: the header of a file, and its pixels, by the kind of the file
- ``pictures``, ``tiff``, ``deep``: files that Pillow reads; TIFF; floats and more than 8 bits
- ``remote``: images behind URLs
- ``pixels``: the encoding of pixels, sRGB or linear light, and the checks of an image
- ``folder``: many images, in blocks
- ``color``: colour spaces: YCbCr, linear light, sRGB, encodings of light above 1, normals
- ``resize``: resampling
- ``sheet``: contact sheets: pictures side by side, with text
- ``metrics``: PSNR, SSIM, MS-SSIM
- ``structure``: differentiable SSIM of tensors
- ``strips``: processing of strips of rows by threads
- ``hilbert``: a curve through the cells of a square
"""
