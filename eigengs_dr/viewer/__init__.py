"""Pages for the browser that draw sets and models as the renderer does.

- ``view``: a set, a fit or a model to a page
- ``set_facts``: what a page knows of a set
- ``model_facts``: what a page knows of a model
- ``photo``: the photo in a page
- ``page``: the page, and the folder ``web/`` with its template, style and programs
"""
