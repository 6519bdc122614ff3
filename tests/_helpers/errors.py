"""What messages of errors have in common."""


def one_line(error):
    """Message of an error, checked to be one line that names a remedy after the complaint."""
    message = str(error.value)
    assert "\n" not in message
    assert ";" in message
    return message
