"""Kill commands at random times, and count what does not go as the manual says.

Each trial starts a command on tiny inputs, sends it a signal after a random time, and runs the same
command once more. Counted are: exit codes other than the manual's, lines beyond one, tracebacks,
second calls that fail, files that stay after the second call, and results that differ from those of
a run that nobody interrupted.

    python tools/kill_commands.py --trials 40
    python tools/kill_commands.py fit pack --trials 5 --seed 3
"""

from __future__ import annotations

import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np

FIT = ["--gaussians", "20", "--iterations", "3"]
SMALL = ["--size", "16x16", "--components", "4", "--gaussians", "30"]


class Command(NamedTuple):
    """A command, and the folders and files that it leaves."""

    words: list[str]
    leaves: set[str]


COMMANDS = {
    "fit": Command(
        ["fit", "photo.png", "-o", "x.npz", "--preview", "x.png", "--report", "x.json", *FIT],
        {"x.npz", "x.png", "x.json"},
    ),
    "folder": Command(
        ["fit", "photos", "-o", "fits", "--report", "x.json", *FIT], {"fits", "x.json"}
    ),
    "large": Command(
        ["fit", "photo.png", "-o", "x.npz", "--blocks", "32", "--iterations", "3"], {"x.npz"}
    ),
    "train": Command(
        ["train", "photos", "-o", "m.npz", "--report", "x.json", *SMALL], {"m.npz", "x.json"}
    ),
    "pack": Command(["pack", "set.npz", "-o", "x.egs", "--report", "x.json"], {"x.egs", "x.json"}),
}


@click.command()
@click.argument("names", nargs=-1, type=click.Choice(list(COMMANDS)))
@click.option("--trials", default=40, show_default=True, help="Of each command and signal.")
@click.option("--seed", default=0, show_default=True)
def main(names: tuple[str, ...], trials: int, seed: int) -> None:
    """Kill commands, by default all, and print a line of counts for each signal."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_inputs(folder / "inputs")
        for command in names or COMMANDS:
            words, leaves = COMMANDS[command]
            whole, started = shutil.copytree(folder / "inputs", folder / command), time.time()
            run(words, whole)
            seconds, chance = time.time() - started, random.Random(f"{seed} {command}")
            for sent in ("KILL", "TERM", "INT"):
                counts: Counter[str] = Counter()
                for _ in range(trials):
                    work = shutil.copytree(folder / "inputs", folder / "work")
                    faults = kill_once(words, leaves, work, whole, sent, chance.uniform(0, seconds))
                    counts.update(fault.partition(":")[0] for fault in faults or ["right"])
                    print(*(f"  {command} {sent}: {fault}\n" for fault in faults), end="")
                    shutil.rmtree(work)
                print(f"{command:8} {sent:5} {seconds:4.1f} s  {dict(counts)}", flush=True)


def write_inputs(folder: Path) -> None:
    """Write two photos, a folder of ten, a scene and a set."""
    from PIL import Image

    (folder / "photos").mkdir(parents=True)
    y, x, c = np.mgrid[:64, :64, :3]
    for number in range(10):
        waves = 127 + 60 * np.sin(x / (5 + number) + c) + 60 * np.cos(y / 7 + number)
        image = Image.fromarray(waves.astype(np.uint8))
        image.resize((32, 32)).save(folder / "photos" / f"{number}.png")
        if not number:
            image.save(folder / "photo.png")
    run(["fit", "photo.png", "-o", "set.npz", *FIT], folder)


def run(words: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a command to its end."""
    program = [sys.executable, "-m", "eigengs_dr", *words]
    return subprocess.run(program, cwd=folder, capture_output=True, text=True, timeout=200)


def kill_once(
    words: list[str], leaves: set[str], work: Path, whole: Path, sent: str, delay: float
) -> list[str]:
    """Interrupt a command after some seconds, run it again, and return what is wrong."""
    program = [sys.executable, "-m", "eigengs_dr", *words]
    process = subprocess.Popen(
        program, cwd=work, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    time.sleep(delay)
    process.send_signal(getattr(signal, f"SIG{sent}"))
    _, said = process.communicate(timeout=200)
    faults = []
    # Before the first line runs, and after the last, Python itself ends as the system says.
    code, early = process.returncode, -getattr(signal, f"SIG{sent}")
    is_own = "/eigengs_dr/" in said or "eigengs-dr" in said
    starts = not is_own and ((not said and code == early) or "KeyboardInterrupt" in said)
    lines = [line for line in said.splitlines() if " note: " not in line]
    if "Traceback" in said and not starts:
        faults.append(f"traceback: {said.strip().splitlines()[-1][:90]}")
    elif sent == "KILL":
        if code not in (0, early):
            faults.append(f"code: {code}")
    elif not starts and (code not in (0, 130) or (code == 130 and len(lines) != 1)):
        faults.append(f"code: {code}, said {said[-200:]!r}")
    again = run(words, work)
    if again.returncode:
        faults.append(f"second call: {again.stderr[-300:]!r}")
    names = {path.name for path in work.iterdir()} - {path.name for path in whole.iterdir()}
    hidden = {str(path.relative_to(work)) for path in work.rglob(".*")}
    if names | hidden:
        faults.append(f"files: {sorted(names | hidden)}")
    if not leaves <= {path.name for path in work.iterdir()}:
        faults.append(f"missing: {sorted(leaves - {path.name for path in work.iterdir()})}")
    return faults + differences(work, whole)


def differences(work: Path, whole: Path) -> list[str]:
    """Return which results differ from those of a run that nobody interrupted."""
    faults = []
    for path in sorted(whole.rglob("*.npz")) + sorted(whole.rglob("*.egs")):
        other = work / path.relative_to(whole)
        if not other.exists() or other.read_bytes() != path.read_bytes():
            faults.append(f"lacks or differs: {other.name}")
    return faults


if __name__ == "__main__":
    main()
