import signal

import pytest

from eigengs_dr.backend.selection import BackendError, select

# A shell that starts the tests in the background has them ignore Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)


def _is_present(backend):
    try:
        select(backend)
    except BackendError:
        return False
    return True


@pytest.fixture(params=[name for name in ("llvm", "cuda") if _is_present(name)])
def backend(request):
    """Name of a backend of this machine: a test that takes it runs once for each."""
    return request.param
