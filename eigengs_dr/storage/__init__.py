"""Files of arrays, whole or not at all. NumPy only.

- ``locks``: one writer for a file or a folder
- ``atomic``: files and folders that appear in one step
- ``npz``: arrays with a format, a version and checks
- ``settings``: the options on which a result depends
- ``checkpoint``: the work of an unfinished training
"""
