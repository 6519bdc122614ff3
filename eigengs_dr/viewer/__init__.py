"""Pages for the browser, pictures, and HTML for notebooks.

- ``view``: the page of a set, a fit or a model; the folder ``web/`` has its template and scripts
- ``pictures``: outlines of Gaussians, components of a model or a basis, and the photo in a page
- ``notebook``: HTML of sets, fits, bases and models for Jupyter
"""
