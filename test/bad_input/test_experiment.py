"""Bad input of what records and compares runs."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import torch
from faults import Fault, Subject, check
from omegaconf import OmegaConf

from torchrl_ecpo.experiment import MetricsTable, compile_module
from torchrl_ecpo.experiment.compare import load_comparison
from torchrl_ecpo.experiment.figures import smooth

RETURNS = (1.0, 3.0, 2.0, 4.0)


def in_folder(call):
    def run(entries):
        with TemporaryDirectory() as folder:
            return call(Path(folder), entries)

    return run


def make_table(folder):
    table = MetricsTable(folder / "metrics.csv")
    for step, value in enumerate(RETURNS):
        table.log_metrics({"return": value}, step=step)
    return table


@in_folder
def log(folder, entries):
    table = make_table(folder)
    metrics = {"return": entries.pop("return")} if "return" in entries else {}
    table.log_metrics(metrics, **entries)
    return table.rows[-1].get("return", 0.0), table.rows[-1]["step"]


@in_folder
def cut_back(folder, entries):
    table = make_table(folder)
    table.cut_back(**entries)
    return [row["return"] for row in table.rows]


@in_folder
def compare(folder, entries):
    make_table(folder)
    OmegaConf.save({"loss": {"name": "ecpo"}}, folder / "config.yaml")
    return load_comparison([folder], **entries).curves["ecpo"]


def smoothed(entries):
    return smooth(np.array(RETURNS), **entries)


def compiled(entries):
    compile_module(**entries, name="network")
    return []


NO_NUMBERS = [Fault(repr(x), x) for x in ("0.5", "text", None, 1j, [0.5], {}, True)]
SUBJECTS = {
    "MetricsTable.log_metrics": Subject(
        log,
        {"return": 2.0, "step": 5},
        faults={"return": NO_NUMBERS},
        fine={("return", "missing"): "not measured", ("step", "5.5"): "frames per copy"},
    ),
    "MetricsTable.cut_back": Subject(
        cut_back, {"step": 2}, fine={("step", "0"): "the first row", ("step", "True"): "1"}
    ),
    "load_comparison": Subject(
        compare,
        {"metric": "return", "smoothing": 0.5},
        optional=["metric", "smoothing"],
    ),
    "smooth": Subject(smoothed, {"fraction": 0.5}, optional=["fraction"]),
    "compile_module": Subject(compiled, {"module": torch.nn.Linear(1, 1)}),
}


@pytest.mark.parametrize("name", SUBJECTS)
def test_experiment(name):
    check(f"`{name}`", SUBJECTS[name])
