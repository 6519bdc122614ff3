"""What the cameras of a Mitsuba scene see of a texture.

- ``visibility``: pixels to texels, by rays from the cameras to the texture
- ``target``: the smoothest texture that looks alike, and the weights of its errors
- ``fit_scene``: the fewest Gaussians for a scene
- ``rendering``: pictures by each camera, with the names of their channels
"""

from .. import plugins  # noqa: F401  without Mitsuba, its error says what to install
