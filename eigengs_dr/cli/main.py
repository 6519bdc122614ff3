"""The command line, ``eigengs-dr``: thin, every command calls one function of the package.

What the commands need is imported inside them, so that ``--help`` and mistakes answer at once.
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


@click.group(cls=Program)
@click.version_option(package_name="eigengs-dr")
def main() -> None:
    """Fit images with 2D Gaussians and render them at any size.

    \b
    Examples:
      eigengs-dr fit photo.jpg -o photo.npz --preview photo-fit.png
      eigengs-dr render photo.npz -o large.png --scale 2
      eigengs-dr pack photo.npz -o photo.egs --image photo.jpg
      eigengs-dr train photos/ -o photos.npz
      eigengs-dr doctor
    """


for command in (fit, render, train, info, pack, scene, doctor, bench):
    main.add_command(command)
