"""The command ``eigengs-dr doctor``: check this machine."""

import json

import click

from .options import json_option


@click.command()
@json_option
@click.pass_context
def doctor(context: click.Context, as_json: bool) -> None:
    """Show what works on this machine and what to install.

    The exit code is 1 if no backend works.

    \b
    Examples:
      eigengs-dr doctor
      eigengs-dr doctor --json
    """
    from ..backend import doctor as doctor_module

    facts = doctor_module.report()
    click.echo(json.dumps(facts, indent=2) if as_json else doctor_module.describe(facts))
    context.exit(0 if facts["llvm"]["works"] or facts["cuda"]["works"] else 1)
