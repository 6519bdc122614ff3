"""Diagnosis of this machine: which backends work, and what to install.

Each backend is tried in its own process, so that a crash ends only this process.
"""

import importlib.util
import json
import os
import platform
import subprocess
import sys
from importlib.metadata import requires

from .selection import (
    BACKENDS,
    INSTALL_ADVICE,
    PATH_VARIABLE,
    candidates,
    version_of,
)
from .types import Record

PROGRAM = """
import json, sys
from eigengs_dr.backend.selection import describe, select
try:
    types = select(sys.argv[1])
    import drjit as dr
    # A libLLVM may load, and still end the process in dr.clip.
    if dr.clip(types.Float(1, 2, 3), 0, 2)[2] != 2:
        raise RuntimeError("wrong result")
    answer = {"works": True, "problem": None, **describe(sys.argv[1])}
except Exception as error:
    answer = {"works": False, "problem": str(error)}
print(json.dumps(answer))
"""
"""Python program that runs a computation on the backend given by its first argument and prints a
JSON object."""

VARIANTS = "import json, mitsuba; print(json.dumps(mitsuba.variants()))"
"""Python program that prints the variants of Mitsuba as JSON."""


def report() -> Record:
    """Try every backend, and collect the versions of the software on this machine.

    This takes one or two seconds, and starts Dr.Jit in other processes only.

    Returns
    -------
    dict
        ``llvm``, ``cuda``, ``metal`` : dict
            ``works`` and ``problem`` (None, or one line with advice). If the backend
            works, also the entries of `eigengs_dr.backend.selection.describe`.
        ``libllvm`` : list of dict
            ``path``, ``version`` and ``usable`` of every library found.
        ``libllvm_path`` : str or None
            Value of ``DRJIT_LIBLLVM_PATH``.
        ``mitsuba`` : dict
            ``version``, None if Mitsuba is not installed; ``variants``, None if it cannot be
            imported.
        ``python``, ``platform`` : str
    """
    return {
        **{backend: _try(backend) for backend in BACKENDS},
        "libllvm": [{**library._asdict(), "usable": library.usable} for library in candidates()],
        "libllvm_path": os.environ.get(PATH_VARIABLE),
        "mitsuba": _mitsuba(),
        "python": platform.python_version(),
        "platform": platform.platform(),
    }


def describe_machine(diagnosis: Record) -> str:
    """Format a report as text.

    Parameters
    ----------
    diagnosis : dict
        The result of `report`.

    Returns
    -------
    str
        Lines for a terminal, without a newline at the end.
    """
    lines = [f"python   {diagnosis['python']} on {diagnosis['platform']}"]
    for name in BACKENDS:
        trial = diagnosis[name]
        if not trial["works"]:
            lines.append(f"{name:8} does not work: {trial['problem']}")
            continue
        versions, detail = trial["versions"], ""
        if name == "llvm":
            library = f"LLVM {versions['libllvm']} at {versions['libllvm_path']}"
            detail = f", {library}, {trial['threads']} threads on {trial['cpu']}"
        lines.append(f"{name:8} works: Dr.Jit {versions['drjit']}{detail}")
    lines.append("libLLVM  found:" if diagnosis["libllvm"] else "libLLVM  none found")
    used = diagnosis["llvm"]["versions"]["libllvm_path"] if diagnosis["llvm"]["works"] else None
    for library in diagnosis["libllvm"]:
        note = "used" if library["path"] == used else "usable" if library["usable"] else "too old"
        lines.append(f"           {library['version'] or '?':>3}  {library['path']} ({note})")
    lines.append(f"mitsuba  {_mitsuba_line(**diagnosis['mitsuba'])}")
    return "\n".join(lines)


def _mitsuba_line(version: str | None, variants: list[str] | None) -> str:
    """Describe the installation of Mitsuba."""
    if version is None:
        return "not installed; only the plugins need it: pip install 'mitsuba>=3.9,<3.10'"
    if variants:
        return f"{version}: {', '.join(variants)}"
    wanted = [r for r in requires("mitsuba") or [] if r.startswith("drjit")]
    pin = f"; it needs {wanted[0]}, and drjit {version_of('drjit')} is installed" if wanted else ""
    return f"{version}: cannot be imported{pin}: pip install 'mitsuba>=3.9,<3.10'"


def _try(name: str) -> Record:
    """Run `PROGRAM` with a backend, in another process."""
    process = _python(PROGRAM, name)
    if process.returncode == 0:
        return dict(json.loads(process.stdout.splitlines()[-1]))
    code = process.returncode
    status = f"signal {-code}" if code < 0 else f"exit code {code}"
    return {"works": False, "problem": f"the process ended with {status}; {INSTALL_ADVICE}"}


def _mitsuba() -> Record:
    """Return the version and the variants of Mitsuba."""
    if importlib.util.find_spec("mitsuba") is None:
        return {"version": None, "variants": None}
    process = _python(VARIANTS)
    variants = json.loads(process.stdout) if process.returncode == 0 else None
    return {"version": version_of("mitsuba"), "variants": variants}


def _python(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python code in a fresh interpreter."""
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)
