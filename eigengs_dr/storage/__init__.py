"""Files to dictionaries of arrays and back, whole or not at all; checkpoints. NumPy only.

- ``atomic``: files and folders that are created in one step, and have one writer at a time
- ``npz``: arrays with a format, a version and checks
- ``memory``: limits of the memory that a file may take
- ``checkpoint``: the state of an unfinished run
"""
