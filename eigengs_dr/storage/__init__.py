"""Files of arrays, whole or not at all. NumPy only.

- ``atomic``: replaces a file in one step; a folder for one run at a time; readers by format
- ``npz``: arrays with a format, a version and checks
- ``checkpoint``: the work of an unfinished training
"""
