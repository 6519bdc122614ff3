"""What the cameras of a Mitsuba scene see of a texture.

- ``visibility``: pixels to texels, by rays from the cameras to the texture
- ``target``: the smoothest texture that looks alike, and the weights of its errors
- ``fit_scene``: the fewest Gaussians for a scene
- ``fit_environment``: the fewest Gaussians for an environment map
- ``bitmaps``: the bitmaps of a scene, and which of them must stay
- ``fit_uses``: Gaussians for the uses of an image in a scene
- ``convert``: a scene with Gaussians in the place of its bitmaps
- ``rendering``: pictures by each camera, with the names of their channels; before and after
"""

from .. import plugins  # noqa: F401  without Mitsuba, its error says what to install
