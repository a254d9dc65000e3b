"""Scripts, started as a user would start them."""

from __future__ import annotations

import csv
import multiprocessing
import subprocess
import sys
from multiprocessing.context import ForkServerProcess
from pathlib import Path

FORKED = multiprocessing.get_context("forkserver")
FORKED.set_forkserver_preload(
    [
        "torchrl_ecpo.collectors",
        "torchrl_ecpo.envs",
        "torchrl_ecpo.experiment.checkpoint",
        "torchrl_ecpo.objectives",
        *("pandas", "stable_baselines3"),  # where they are, TensorDict and TorchRL import them
    ]
)
AS_A_PROGRAM = """
import os, runpy, sys
os.chdir({directory!r})
for stream, name in ((1, ".stdout"), (2, ".stderr")):
    os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
sys.argv = {command!r}
sys.path.insert(0, os.path.dirname(sys.argv[0]))
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def start_script(directory: Path, script: Path, *options: str) -> ForkServerProcess:
    """Start a script in a directory; what it prints is in ``.stdout`` and ``.stderr`` there.

    Its process is forked from one that has imported torch, which takes a new interpreter most of a
    short run.
    """
    code = AS_A_PROGRAM.format(directory=str(directory), command=[str(script), *options])
    process = FORKED.Process(target=exec, args=(code, {}))
    process.start()
    return process


def run_script(
    directory: Path, script: Path, *options: str, afresh: bool = False
) -> subprocess.CompletedProcess[str]:
    """Run a script in a directory to its end.

    `afresh` takes a new interpreter: for what ends with ``atexit``, or compiles.
    """
    command = [str(script), *options]
    if afresh:
        command = [sys.executable, *command]
        return subprocess.run(command, capture_output=True, text=True, cwd=directory, check=False)
    process = start_script(directory, script, *options)
    process.join()
    output, errors = ((directory / name).read_text() for name in (".stdout", ".stderr"))
    return subprocess.CompletedProcess(command, process.exitcode or 0, output, errors)


def record(directory: Path) -> list[dict[str, str]]:
    """The rows of a run as they are written, but for the clock."""
    with (directory / "metrics.csv").open(newline="") as file:
        return [
            {name: cell for name, cell in row.items() if name != "steps_per_second"}
            for row in csv.DictReader(file)
        ]
