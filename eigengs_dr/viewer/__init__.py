"""Pages for the browser, pictures, and HTML for notebooks.

- ``view``: the page of a set, a fit or a model, and HTML for Jupyter; the folder ``web/`` has the
  template of a page and its scripts
- ``pictures``: outlines of Gaussians, components of a model or a basis, and the photo in a page
"""
