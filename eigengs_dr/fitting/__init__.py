"""From an image, maps or a loss to Gaussians: problem, placement, loop, controls, search.

- ``fit``: `fit`, from its arguments to the result
- ``problem``, ``options``: what a fit was given, and its checks
- ``start``: a start of the user, and levels of detail
- ``objective``: what a picture should match, and its quadratic model; ``loss``: a loss of the user
- ``loop``: a descent with a trace, which keeps the best set; ``step``, ``state``: one step of it
- ``method``: a method as a value: placement, optimiser, rates, controls
- ``control``: when Gaussians are added, moved and removed between steps; ``exchange``,
  ``redistribution``, ``peaks``: what is done to them
- ``place``: where Gaussians start; ``solve``: their colours by linear least squares
- ``search``: the smallest number of Gaussians for a goal
- ``coarse``, ``from_loss``: a fit without an image, by texels
- ``channels``: what the channels of a set should show, and the PSNRs of what they do
"""
