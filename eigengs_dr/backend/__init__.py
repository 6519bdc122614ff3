"""Dr.Jit on this machine: libLLVM, choice of a backend, array types, frozen programs."""
