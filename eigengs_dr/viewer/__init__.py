"""What people look at: pages for the browser, pictures, and what a notebook shows.

- ``view``: a page of a set, a fit or a model; the folder ``web/`` has its template and programs
- ``facts``: what a page knows of a set and of a model
- ``pictures``: outlines of Gaussians, and the photo in a page
- ``sheets``: components of a model or a basis
- ``notebook``: what Jupyter shows of sets, fits, bases and models
"""
