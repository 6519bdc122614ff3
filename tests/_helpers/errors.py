"""What messages of errors have in common."""

from contextlib import contextmanager

import pytest

import eigengs_dr as eg


def complaint(kind, function, *arguments, **options):
    """The message of an error of exactly this type, checked to be one short line."""
    with pytest.raises((TypeError, ValueError)) as error:
        function(*arguments, **options)
    message = str(error.value)
    assert type(error.value) is kind or (kind is ValueError and type(error.value) is eg.ImageError)
    assert message.isprintable() and 10 < len(message) < 300
    return message


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


def check_refused(path, content, words=""):
    """Check that a set of this content is refused in one line that names its file."""
    path.write_bytes(content)
    with file_refused(path, words):
        eg.Gaussians.load(path)


@contextmanager
def refused(kind, match):
    """Expect an error whose message is one line with a remedy."""
    with pytest.raises(kind, match=match) as error:
        yield error
    one_line(error)
