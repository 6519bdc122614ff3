"""Photos of one object under many lights: planes on shared Gaussians, and a table of lights.

- ``lights``: directions of lights, files ``.lp``, the table and how it is interpolated
- ``directions``: latitudes and longitudes of all directions, an octahedron of those above a plane
- ``fit``: from photos to planes, their number and that of the Gaussians
- ``model``: the model, which gives a set for any light
- ``planes``: planes of pixels, as other viewers read them
"""
