"""Files of arrays, whole or not at all. NumPy only.

- ``atomic``: replaces a file in one step
- ``npz``: arrays with a format, a version and checks
- ``readers``: readers of other formats, by the first bytes of a file
- ``checkpoint``: the work of an unfinished training
- ``lock``: a folder for one run at a time
"""
