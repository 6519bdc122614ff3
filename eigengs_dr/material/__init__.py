"""Materials: several maps on one set of shapes.

- ``maps``: the name, space and channels of a map
- ``material``: the shared Gaussians, and the set of each map
- ``file``: the .npz file
- ``target``: the images of all maps as one image of many channels
- ``fit_material``: images to a material
"""
