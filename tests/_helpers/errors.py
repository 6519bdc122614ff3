"""What messages of errors have in common."""

from contextlib import contextmanager

import pytest


def one_line(error):
    """Message of an error, checked to be one line that names a remedy after the complaint."""
    message = str(error.value)
    assert "\n" not in message
    assert ";" in message
    return message


@contextmanager
def refused(kind, match):
    """Expect an error whose message is one line with a remedy."""
    with pytest.raises(kind, match=match) as error:
        yield error
    one_line(error)
