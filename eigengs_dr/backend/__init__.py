"""Dr.Jit on this machine: libLLVM, the choice of a backend, array types, recorded programs."""
