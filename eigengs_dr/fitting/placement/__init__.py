"""Where Gaussians start, and where they are added.

- ``adaptive``: placement by second derivatives of the image
- ``redistribution``: placing the Gaussians of a fit anew, by its error
- ``peaks``: where an added Gaussian would reduce the error most
- ``curve``: a Hilbert curve, along which neighbours in memory are close in space
"""
