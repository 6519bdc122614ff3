"""``python -m eigengs_dr``: the command line."""

from .cli.main import main

main()
