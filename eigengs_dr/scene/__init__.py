"""What the cameras of a Mitsuba scene see of a texture.

- ``visibility``: pixels to texels; ``rays``: from the cameras to the texture
- ``back_projection``: the smoothest texture that looks alike
- ``target``: the texture to fit, and the weights of its errors
- ``fit_scene``: the fewest Gaussians for a scene
- ``bitmaps``: the bitmaps of a scene, and which of them must stay
- ``convert``: a scene with Gaussians in the place of its bitmaps
- ``compare_renderings``: pictures of a scene before and after
- ``passes``: renderings in passes of samples
"""

from .. import plugins  # noqa: F401  without Mitsuba, its error says what to install
