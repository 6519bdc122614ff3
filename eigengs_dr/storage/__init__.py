"""Atomic storage of arrays in files. Depends on NumPy only.

- ``locks``: one writer at a time for a file or a folder
- ``atomic``: files and folders that are created in one step
- ``npz``: arrays with a format, a version and checks
- ``memory``: limits of the memory that a file may take
- ``settings``: the options on which a result depends
- ``checkpoint``: the state of an unfinished run
"""
