"""The program ``eigengs-dr``: each command calls one function of the package.

Commands import heavy modules when they run, so that ``--help`` and mistakes answer at once.
"""

import click

from .bench import bench
from .console import Program
from .doctor import doctor
from .fit import fit
from .info import info
from .pack import pack
from .render import render
from .scene import scene
from .train import train
from .view import view


@click.group(cls=Program)
@click.version_option(package_name="eigengs-dr")
def main() -> None:
    """Fit images with 2D Gaussians and render them at any size.

    \b
    Examples, in the order to run them first:
      eigengs-dr doctor                                     Check this machine.
      eigengs-dr fit photo.jpg --preview fit.png            Write photo.npz.
      eigengs-dr info photo.npz                             Show what it holds.
      eigengs-dr render photo.npz -o large.png --scale 2    Render it larger.
      eigengs-dr pack photo.npz -o photo.egs                Make it small.
      eigengs-dr view photo.npz --open                      Look at it in the browser.

    "eigengs-dr COMMAND --help" describes a command.
    """


for command in (fit, render, train, info, pack, view, scene, doctor, bench):
    main.add_command(command)
