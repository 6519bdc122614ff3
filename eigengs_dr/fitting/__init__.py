"""From an image to its Gaussians.

- ``fit``: `fit`, from the image to the result
- ``options``: the options of a fit, checked once
- ``presets``: named methods
- ``initializers``: the registry of starts
- ``refine``: a descent with a trace
- ``redistribute``: placement and colours; placement again, by the error
- ``density_control``: dropping and adding Gaussians
- ``search``: the smallest number of Gaussians for a PSNR
- ``levels``: levels of detail
- ``placement``: where Gaussians start (NumPy)
- ``solvers``: colours by linear least squares
- ``optimizers``: variables, optimisers, schedules, steps
"""
