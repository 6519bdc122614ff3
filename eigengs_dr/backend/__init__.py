"""Access to Dr.Jit on this machine, and messages to the user.

- ``libllvm``: finds a libLLVM that works, before Dr.Jit loads one
- ``selection``: picks llvm or cuda
- ``arrays``: matching array types; copies of NumPy arrays; exact arithmetic on cuda
- ``recording``: frozen programs; one thread at a time
- ``doors``: the entry points of the package, which take the lock of Dr.Jit
- ``types``: names of types for annotations
- ``messages``: warnings, and text for a terminal
- ``progress``: progress bars
- ``interrupts``: Ctrl-C and SIGTERM, between steps and at the end of the program
- ``notebook``: pictures in a notebook
- ``executor``: where tasks run, in this process or on a cluster
- ``doctor``: what works here and what to install
"""
