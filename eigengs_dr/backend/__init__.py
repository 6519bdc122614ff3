"""Dr.Jit on this machine, and the person in front of it.

- ``libllvm``: finds a libLLVM that works, before Dr.Jit loads one
- ``selection``: picks llvm or cuda
- ``arrays``: array types that go together; copies of NumPy arrays; exact arithmetic on cuda
- ``recording``: frozen programs; one thread at a time
- ``doors``: what callers reach the package by, and where it takes the lock
- ``types``: the words of annotations
- ``messages``: warnings, and text for a terminal
- ``progress``: bars
- ``interrupts``: Ctrl-C and SIGTERM between steps
- ``notebook``: pictures in a notebook
- ``ending``: how the program ends by Ctrl-C or SIGTERM
- ``executor``: where tasks run, in this process or on a cluster
- ``doctor``: what works here and what to install
"""
