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
def file_refused(path, words=""):
    """Expect an error whose message is one line that starts with the name of a file."""
    with pytest.raises(ValueError) as error:
        yield
    message = str(error.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    assert words in message
    assert len(message) < len(str(path)) + 300


@contextmanager
def refused(kind, match):
    """Expect an error whose message is one line with a remedy."""
    with pytest.raises(kind, match=match) as error:
        yield error
    one_line(error)
