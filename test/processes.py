"""Scripts, started as a user would start them."""

from __future__ import annotations

import csv
import multiprocessing
import subprocess
import sys
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import Checkpoint

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


def checkpoints(directory: Path) -> list[Path]:
    """From the oldest on."""
    return sorted((directory / "checkpoints").iterdir())


def last_state(directory: Path, part: str) -> Any:
    """A part of the last checkpoint."""
    path = checkpoints(directory)[-1]
    return torch.load(path / Checkpoint.manifest(path)["components"][part]["path"] / "state.pt")


def assert_same_run(one: Path, other: Path) -> None:
    """The same rows, and the same state at the end."""
    assert record(one) == record(other)
    for part in ("loss_module", "optimizer"):
        states = [last_state(directory, part) for directory in (one, other)]
        torch.testing.assert_close(*states, rtol=0, atol=0, equal_nan=True)
    randoms = [last_state(directory, "random")["torch_cpu"] for directory in (one, other)]
    assert torch.equal(*randoms)


def contents(directory: Path) -> dict[str, bytes | None]:
    """What is in all files, by name."""
    files = directory.rglob("*")
    return {str(file): file.read_bytes() if file.is_file() else None for file in files}
