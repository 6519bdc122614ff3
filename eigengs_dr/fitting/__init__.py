"""From an image to its Gaussians.

- ``fit``: `fit`, from the image to the result
- ``loop``: a descent with a trace, which keeps the best set
- ``descent``: the loop over the steps, the state between them, and the program of one step
- ``objective``: what a picture should match, and its quadratic model
- ``method``: a method as a value: placement, optimiser, rates, controls
- ``control``: adds, moves and removes Gaussians between steps, by means of ``exchange``
- ``place``: where Gaussians start; ``placement``: the placement by the image
- ``solve``: colours by linear least squares
- ``variables``, ``optimizer``: what a step moves, and how far
- ``fewest``: the smallest number of Gaussians for a PSNR
- ``levels``: levels of detail
- ``maps``: several maps as one image of many channels
- ``options``, ``pixels``, ``start``: checks of what the caller gives
- ``measure``: PSNRs of a set
"""
