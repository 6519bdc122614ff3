"""Dr.Jit on this machine: libLLVM, the choice of a backend, arrays, frozen programs, entry points.

- ``selection``: finds a libLLVM that works, before Dr.Jit loads one, and picks llvm or cuda
- ``arrays``: matching array types; copies of NumPy arrays; exact arithmetic on cuda
- ``recording``: frozen programs; one thread at a time
- ``entry_points``: the entry points of the package: their numbers, progress bars and lock
- ``types``: names of types for annotations
- ``messages``: warnings, text for a terminal, pictures in a notebook
- ``plain``: JSON from files, with limits
- ``interrupts``: Ctrl-C and SIGTERM, between steps and at the end of the program
- ``executor``: where tasks run, in this process or on a cluster
- ``doctor``: what works here and what to install
"""
