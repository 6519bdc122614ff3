"""What people look at: pages for the browser, pictures, and what a notebook shows.

- ``view``: a set, a fit or a model to a page
- ``set_facts``: what a page knows of a set
- ``model_facts``: what a page knows of a model
- ``photo``: the photo in a page
- ``page``: the page; the folder ``web/`` has its template, style and programs
- ``pictures``: outlines of Gaussians
- ``sheets``: components of a model or a basis
- ``notebook``: what Jupyter shows of sets, fits, bases and models
- ``curve``: a chart of one curve
- ``short_errors``: errors in a notebook
"""
