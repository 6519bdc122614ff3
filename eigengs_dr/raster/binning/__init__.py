"""Which Gaussians touch which tile, and which lane does what.

- ``tiles``: the tiles of an image, and the tiles that an ellipse touches
- ``lists``: the Gaussians of every tile, and the tiles of every Gaussian in pieces
- ``transpose``: from the tiles by Gaussian to the Gaussians by tile
- ``lanes``: the order of lanes, so that packets and cores have like work
- ``granularity``: how much work a lane gets, by backend
"""
