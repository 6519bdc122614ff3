"""The command line, in this process, and what all of its commands keep to."""

from importlib.metadata import entry_points

import numpy as np
from click.testing import CliRunner
from PIL import Image

(program,) = entry_points(group="console_scripts", name="eigengs-dr")
main = program.load()


def run(*arguments):
    """Result of a command, in this process."""
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def succeeded(result):
    """Return a result, checked to be that of a command that ended well."""
    assert result.exit_code == 0, result.output
    return result


def said(*arguments):
    """Return what a command writes that ends well."""
    return succeeded(run(*arguments)).stdout


def assert_refused(result, *words):
    """Check that a command ended with exit code 2 and one line that names what went wrong."""
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert result.stderr.startswith("eigengs-dr: error: ")
    assert result.stderr.count("\n") == 1
    for word in words:
        assert str(word) in result.stderr


def smooth_pixels(width, height, channels=3):
    """A picture of 8-bit waves."""
    y, x, c = np.mgrid[:height, :width, :channels]
    return (127 + 60 * np.sin(x / 5 + c) + 60 * np.cos(y / 7)).astype(np.uint8)


def previewed(path):
    """The parts of a preview of 32 pixels width: one of every 16 pixels, which repeat it."""
    return np.split(np.asarray(Image.open(path))[::16, ::16], 3, axis=1)


SMALL = ["--size", "32x32", "--components", 6, "--gaussians", 60]
"""Options of a training that takes a second."""
