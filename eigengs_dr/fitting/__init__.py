"""From an image to its Gaussians.

- ``fit``: `fit`, from the image to the result
- ``options``: the options of a fit, checked once, and the named methods
- ``target``: the pixels, and the same in the space of the colours
- ``maps``: several maps as one image of many channels
- ``start``: placement and colours
- ``descent``: gradient descent: the problem, the driver and the program of one step
- ``schedule``: rates and rounds
- ``parameterization``: the variables that are moved; Adam and Adan
- ``density_control``: Gaussians that leave, move and are added
- ``refine``: a descent with a trace
- ``search``: the smallest number of Gaussians for a PSNR
- ``levels``: levels of detail
- ``placement``: where Gaussians start, and start anew by the error of a fit
- ``solvers``: colours by linear least squares
"""
