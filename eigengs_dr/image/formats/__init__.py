"""Files of pixels that Pillow does not keep: floats, and more than 8 bits of colour.

- ``openimageio``: EXR, Radiance HDR, and PNG of 16 bits
- ``pfm``: portable float maps
- ``tiff``: TIFF of 16 bits and of floats
- ``registry``: which function reads and writes a file
"""
