"""One word for one thing: what users write, in Python and on the command line."""

import inspect

import click

import eigengs_dr as eg
from eigengs_dr.cli.main import main

OTHER_WORDS = {
    "spaces": "space",
    "most": "max_gaussians",
    "steps": "iterations",
    "folder": "output",
    "maps": "images",
    "budget": "max_psnr_drop",
    "psnr": "target_psnr",
    "target": "target_psnr",
    "color": "space",
}
"""Words that a parameter may not have, and the word for it."""

CALLS = {
    f"{owner.__name__}.{name}": call
    for owner in (eg, eg.EigenGS, eg.Eigenbasis, eg.Relightable)
    for name in (eg.__all__ if owner is eg else dir(owner))
    if not name.startswith("_") and name not in ("save", "load")
    if inspect.isfunction(call := getattr(owner, name)) or inspect.ismethod(call)
}


def test_functions_use_one_word_for_one_thing():
    wrong = [
        f"{name}({word}): {OTHER_WORDS[word]}"
        for name, call in CALLS.items()
        for word in inspect.signature(call).parameters
        if word in OTHER_WORDS
    ]
    assert not wrong


def test_commands_use_the_words_of_the_functions():
    wrong = [
        f"{command.name} {name}"
        for command in main.commands.values()
        if isinstance(command, click.Command) and command.name != "bench"
        for parameter in command.params
        for name in [opt for opt in parameter.opts if opt.startswith("--")][:1]
        if name.lstrip("-").replace("-", "_") in OTHER_WORDS.keys() - {"target"}
    ]
    assert not wrong
