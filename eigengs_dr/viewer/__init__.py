"""What people look at: pages for the browser, pictures, and what a notebook shows.

- ``view``: a page of a set, a fit or a model; the folder ``web/`` has its template and programs
- ``pictures``: outlines of Gaussians, components of a model or a basis, and the photo in a page
- ``notebook``: what Jupyter shows of sets, fits, bases and models
"""
