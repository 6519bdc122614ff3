"""Dr.Jit on this machine.

- ``libllvm``: finds a libLLVM that works, before Dr.Jit loads one
- ``selection``: picks llvm or cuda
- ``arithmetic``: functions that cuda approximates too coarsely
- ``arrays``: array types that go together; copies of NumPy arrays
- ``recording``: frozen programs; one thread at a time
- ``interrupt``: Ctrl-C and SIGTERM between steps
- ``executor``: where tasks run, in this process or on a cluster
- ``doctor``: what works here and what to install
"""
