"""One training run: its directory, its record, its progress bar and its picture."""

from __future__ import annotations

import csv
import hashlib
import importlib.metadata
import io
import json
import math
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import wraps
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
from filelock import BaseFileLock, FileLock, Timeout
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from hydra.utils import to_absolute_path
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.checkpoint import CheckpointError
from torchrl.record.loggers import Logger, get_logger
from tqdm import tqdm

from torchrl_ecpo.checks import as_float, check_choice
from torchrl_ecpo.experiment.figures import plot_learning_curve
from torchrl_ecpo.experiment.options import flatten

__all__ = ["METRICS_FILE", "MetricsTable", "Run", "leaving_nothing", "read_metrics"]

METRICS_FILE = "metrics.csv"
"""Name of the record in the directory of a run."""
LOCK = ".lock"
PATIENCE = 5.0  # seconds that what a killed run has left behind may hold its lock
KEPT = {METRICS_FILE, "checkpoints"}  # what is worth keeping of a run that fails
TOLD = (ValueError, LookupError, OSError, ImportError, CheckpointError)
"""Errors whose message is all that a user needs, if they come before a run has begun."""
BACKENDS = ("csv", "tensorboard", "wandb")
RECORDED_PACKAGES = ("torchrl-ecpo", "torch", "torchrl", "tensordict", "gymnasium", "numpy")

Metrics = Mapping[str, float | Tensor]


class MetricsTable:
    """The record of a run: one csv table, a row for each logged step, written at once.

    TorchRL's ``CSVLogger`` writes a file without a header for each scalar; a run is easier to read,
    to commit and to continue as one table.

    Args:
        path: of the csv file.

    Raises:
        ValueError: by :meth:`log_metrics` and :meth:`cut_back`, for a step that does not go on.

    Examples:
        >>> import tempfile
        >>> table = MetricsTable(Path(tempfile.mkdtemp(), "metrics.csv"))
        >>> table.log_metrics({"return": 1.0}, step=10)
        >>> table.log_metrics({"return": 2.0, "evaluation": 3.0}, step=20)
        >>> table.rows
        [{'step': 10, 'return': 1.0}, {'step': 20, 'return': 2.0, 'evaluation': 3.0}]
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: list[dict[str, float]] = []
        self._columns: list[str] = []
        self._written: tuple[int, ...] | None = None

    def log_metrics(self, metrics: Mapping[str, float], step: int) -> None:
        """Append a row. A new column rewrites the file, with empty cells in earlier rows.

        Raises:
            ValueError: if the step is not beyond that of the row before, if a metric is called
                step, or if anything is no number.
        """
        step = _as_step(step)
        if self.rows and not step > self.rows[-1]["step"]:
            raise ValueError(f"step must grow, got {step} after {self.rows[-1]['step']}.")
        self.restore()
        if "step" in metrics:
            raise ValueError("A metric cannot be called step, as the first column is: rename it.")
        row = {"step": step, **{name: as_float(name, value) for name, value in metrics.items()}}
        self.rows.append(row)
        if any(name not in self._columns for name in row):
            self._columns = _columns(self.rows)
            self._rewrite()
            return
        text = _table(self._columns, [row], with_header=False)
        with self.path.open("a", newline="") as file:
            file.write(text)
        self._written = self._stat()

    def restore(self) -> None:
        """Write all rows anew, and say so, if another program has changed or removed the file."""
        if self._written not in (None, self._stat()):
            self._rewrite()
            print(
                f"{self.path} was changed or removed by another program: it is written anew, with "
                "all rows of this run.",
                file=sys.stderr,
            )

    def _stat(self) -> tuple[int, ...] | None:
        """What differs once another program has changed the file; None if it has removed it."""
        with suppress(FileNotFoundError):
            stat = self.path.stat()
            return stat.st_ino, stat.st_size, stat.st_mtime_ns

    def _rewrite(self) -> None:
        _write(self.path, _table(self._columns, self.rows))
        self._written = self._stat()

    @property
    def sha256(self) -> str:
        """Hash of the table."""
        return _sha256(self._columns, self.rows)

    def cut_back(self, step: int, sha256: str | None = None) -> None:
        """Continue the file as it was at a step: later rows and half a row are dropped.

        Args:
            step: of the last row.
            sha256: of the table at that step; None: not compared.

        Raises:
            ValueError: if the file does not reach to that step, or was another then.
        """
        rows: list[dict[str, float]] = []
        # A row that cannot be read is the last.
        with (
            suppress(FileNotFoundError, ValueError, TypeError, KeyError, csv.Error),
            self.path.open(newline="") as file,
        ):
            for cells in csv.DictReader(file):
                row = {name: float(cell) for name, cell in cells.items() if cell}
                row["step"] = json.loads(cells["step"])
                if None in cells.values() or row["step"] > step:
                    break
                rows.append(row)
        columns = _columns(rows)
        is_other = sha256 not in (None, _sha256(columns, rows))
        if is_other or step != (rows[-1]["step"] if rows else 0):
            raise ValueError(
                f"{self.path} does not reach to step {step}, where the run goes on, with the rows "
                "that were logged: put back those that are missing or were changed."
            )
        self.rows, self._columns = rows, columns
        self._rewrite()


def _columns(rows: Sequence[Mapping[str, float]]) -> list[str]:
    return list(dict.fromkeys(name for row in rows for name in row))


def _sha256(columns: Sequence[str], rows: Sequence[Mapping[str, float]]) -> str:
    return hashlib.sha256(_table(columns, rows).encode()).hexdigest()


def _table(
    columns: Sequence[str], rows: Sequence[Mapping[str, float]], *, with_header: bool = True
) -> str:
    file = io.StringIO()
    writer = csv.DictWriter(file, columns)
    if with_header and columns:
        writer.writeheader()
    writer.writerows(rows)
    return file.getvalue()


def read_metrics(run_directory: Path | str) -> dict[str, list[float]]:
    """Read the record of a run: a column of numbers for each metric, NaN where a cell is empty.

    Args:
        run_directory: of a run, or of any folder with its ``metrics.csv``.

    Raises:
        FileNotFoundError: if there is no record.
    """
    path = Path(run_directory) / METRICS_FILE
    if not path.is_file():
        raise FileNotFoundError(
            f"There is no {METRICS_FILE} in {run_directory}: is it the directory of a run?"
        )
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = rows[0] if rows else []
    return {name: [float(row[name] or "nan") for row in rows] for name in names}


class Run:
    """A training run in the current directory: record, loggers, progress bar, picture.

    Writes ``config.yaml``, ``versions.json`` and ``command.txt`` as it begins, ``metrics.csv`` as
    it goes, and at the end ``summary.json`` and ``curve.png``, if any of ``shown`` was measured.
    Use it as a context manager; a run that is interrupted keeps its record and still draws its
    picture.

    Args:
        config: the composed configuration; needs ``seed`` and ``logger`` with ``backend``
            (``csv``: the record alone; ``tensorboard`` or ``wandb``: that too), ``project`` and
            ``wandb_mode``.

    Keyword Args:
        total: number of steps of the run, for the progress bar.
        unit: what a step is, for the bar and the picture's axis.
        name: of the run, in titles and loggers.
        shown: metrics that the progress bar shows, and the picture, a panel each.
        directory: where to write; defaults to the working directory.
        show_bar: whether there is a progress bar; default True.
        stack_size: number of runs that share the process, for the summary; default 1.

    Raises:
        ValueError: for an unknown backend.

    Examples:
        >>> import tempfile
        >>> logger = {"backend": "csv", "project": "mine", "wandb_mode": "offline"}
        >>> run = Run(
        ...     OmegaConf.create({"seed": 1, "logger": logger}), total=20, unit="trajectories",
        ...     name="mine", shown=[], directory=tempfile.mkdtemp(), show_bar=False)
        >>> with run:
        ...     run.log({"return": 1.0}, step=10)
        ...     run.log({"return": 2.0}, step=20)
        >>> read_metrics(run.directory)
        {'step': [10.0, 20.0], 'return': [1.0, 2.0]}
    """

    def __init__(
        self,
        config: DictConfig,
        *,
        total: int,
        unit: str,
        name: str,
        shown: Sequence[str],
        directory: Path | str = ".",
        show_bar: bool = True,
        stack_size: int = 1,
    ) -> None:
        check_choice("logger.backend", config.logger.backend, BACKENDS)
        self.config = config
        self.name, self.unit, self.shown = name, unit, shown
        self.directory = Path(directory).resolve()
        self.stack_size = stack_size
        self.step = 0
        self.table = MetricsTable(self.directory / METRICS_FILE)
        self._latest: dict[str, float] = {}
        self._logger: Logger | None = None
        self._wandb_id = uuid4().hex[:8]
        self._has_begun = self._is_resumed = False
        self._bar = tqdm(
            total=total,
            unit=f" {unit}",
            desc=name,
            disable=not show_bar,
            # A log file gets a line now and then, a terminal a lively bar.
            mininterval=0.5 if sys.stderr.isatty() else 30.0,
        )
        self._started = time.monotonic()

    def begin(self) -> None:
        """Write what the run is made with, open its logger, and remove what is not its own.

        The first :meth:`log` does it, and ``Checkpoints.attach``, once all parts are where they
        were. What is refused before that leaves a run that was here as it is.
        """
        if self._has_begun:
            return
        self._has_begun = True
        (self.directory / "summary.json").unlink(missing_ok=True)  # that of a shorter run
        if not self._is_resumed:
            for name in (METRICS_FILE, "curve.png", "versions.json", "command.txt"):
                (self.directory / name).unlink(missing_ok=True)
        _write(self.directory / "config.yaml", OmegaConf.to_yaml(self.config, resolve=True))
        self._write_versions()
        with (self.directory / "command.txt").open("a") as file:
            file.write(f"{shlex.join(command_line())}\n")
        if self.config.logger.backend != "csv":
            self._logger = self._make_logger()

    def _write_versions(self) -> None:
        """The present ones, and below ``earlier`` others with which the run was made before."""
        path, versions = self.directory / "versions.json", _versions()
        with suppress(FileNotFoundError, ValueError):
            before = json.loads(path.read_text())
            earlier = before.pop("earlier", []) + [before] * (before != versions)
            versions |= {"earlier": earlier} if earlier else {}
        _write_json(path, versions)

    def _make_logger(self) -> Logger:
        config = self.config
        logger = get_logger(
            config.logger.backend,
            logger_name=str(self.directory),
            experiment_name=self.name.replace("/", "_"),
            wandb_kwargs={
                "id": self._wandb_id,
                "project": config.logger.project,
                "mode": config.logger.wandb_mode,
                "reinit": "create_new",  # of stacked runs each has its own
            },
        )
        assert logger is not None
        logger.log_hparams(flatten(OmegaConf.to_container(config, resolve=True)))
        return logger

    def log(self, metrics: Metrics | TensorDictBase, step: int) -> None:
        """Record the metrics of a step, whose number must grow.

        Raises:
            FloatingPointError: as :meth:`check`; what was recorded stays.
        """
        step = _as_step(step)
        values = {str(name): float(value) for name, value in metrics.items()}
        self.begin()
        self.table.log_metrics(values, step)
        if self._logger is not None:
            self._logger.log_metrics(values, step)
        # Metrics that are not measured at every step stay on the bar as they last were.
        self._latest.update(values)
        shown = {name: f"{self._latest[name]:.3g}" for name in self.shown if name in self._latest}
        self._bar.set_postfix(shown, refresh=False)
        self._bar.update(step - self.step)
        self.step = step
        self.check(values, step)

    def check(self, values: Metrics | TensorDictBase, step: int) -> None:
        """Stop the run before it is spoilt; other metrics than these may be what they like.

        Raises:
            FloatingPointError: if a loss or the norm of the gradient is NaN or infinite.
        """
        for name, value in values.items():
            is_checked = str(name).startswith(("loss", "grad_norm"))
            if is_checked and not math.isfinite(value):
                raise FloatingPointError(
                    f"{name} is {float(value)} at {self.unit} {step}: the run stops before the "
                    "parameters are spoilt further. A lower learning rate or a higher temperature "
                    "may help."
                )

    def state_dict(self) -> dict[str, Any]:
        """Where the record stands."""
        seconds = time.monotonic() - self._started
        return {
            "step": self.step,
            "record": self.table.sha256,
            "latest": dict(self._latest),
            "seconds": seconds,
            "wandb_id": self._wandb_id,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on there: the record is cut back to it.

        Raises:
            ValueError: if the record does not reach there, or was another.
        """
        self.table.cut_back(state_dict["step"], state_dict["record"])
        self.step, self._latest = state_dict["step"], dict(state_dict["latest"])
        self._wandb_id = state_dict.get("wandb_id", self._wandb_id)
        self._is_resumed = True
        self._started = time.monotonic() - state_dict["seconds"]
        self._bar.initial = self._bar.n = self.step

    def __enter__(self) -> Run:
        """Return the run itself."""
        return self

    def __exit__(self, kind: Any, error: BaseException | None, traceback: Any) -> None:
        """Close the bar and the loggers; write the summary and the picture, also after an error."""
        self._bar.close()
        if self._logger is not None:
            self._logger.close()
        if not self.table.rows:
            return
        self.table.restore()
        summary = {
            "finished": error is None,
            "seconds": round(time.monotonic() - self._started, 1),
            "stack_size": self.stack_size,
            self.unit: self.step,
            **{k: value if math.isfinite(value) else None for k, value in self._latest.items()},
        }
        _write_json(self.directory / "summary.json", summary)
        picture = plot_learning_curve(
            self.table.rows,
            self.directory / "curve.png",
            metrics=self.shown,
            title=self.name,
            x_label=self.unit,
        )
        if picture is not None:
            print(f"{self.name}: learning curve in {picture}")


def _as_step(step: Any) -> Any:
    """A step as Python's own number, which json writes; refuse what is none."""
    if not math.isfinite(as_float("step", step)):
        raise ValueError(f"step must be finite, got {step}.")
    return step.item() if isinstance(step, (Tensor, np.generic)) else step


def command_line() -> list[str]:
    """What a user has typed; of a sweep, what starts this run alone."""
    is_typed = not HydraConfig.initialized() or HydraConfig.get().mode == RunMode.RUN
    if is_typed:
        return ["python", sys.argv[0], *sys.argv[1:]]
    hydra = HydraConfig.get()
    given = [each.path for each in hydra.runtime.config_sources if each.provider == "command-line"]
    folders = [f"--config-dir={path}" for path in given]
    return ["python", sys.argv[0], *folders, *hydra.overrides.task]


def leaving_nothing(main: Callable[[DictConfig], None]) -> Callable[[DictConfig], None]:
    """A script's ``main`` that leaves nothing behind if it fails before a run has its first row.

    What is wrong with the options is then said in one line; HYDRA_FULL_ERROR=1 has the traceback.
    A directory in which another process makes a run is refused, and left as it is.
    """

    @wraps(main)
    def run(config: DictConfig) -> None:
        before = _present()
        lock = _lock(Path.cwd())
        try:
            main(config)
        except Exception as error:
            has_begun = _clear(_present() - before)
            is_alone = HydraConfig.initialized() and HydraConfig.get().mode == RunMode.RUN
            is_told = isinstance(error, TOLD) and "HYDRA_FULL_ERROR" not in os.environ
            if has_begun or not is_alone or not is_told:
                raise
            message = error.args[0] if isinstance(error, KeyError) else error
            raise SystemExit(f"{_script()}: {message}") from None
        finally:
            lock.release()

    return run


def refuse_resume(config: DictConfig) -> None:
    """For a script that writes no checkpoints.

    Raises:
        ValueError: for ``resume=`` of a directory.
    """
    if config.resume not in (None, "auto"):
        raise ValueError(
            f"resume={config.resume}: {_script()} writes no checkpoints, and would begin anew "
            "there. Leave out resume."
        )


def _script() -> str:
    return Path(sys.argv[0]).name


def _lock(directory: Path) -> BaseFileLock:
    """Held until it is released or the process ends, whatever ends it."""
    lock = FileLock(directory / LOCK, timeout=PATIENCE)
    try:
        lock.acquire()
    except Timeout:
        raise SystemExit(
            f"{_script()}: {directory} is in use: another process makes this run. Wait until it "
            "has ended, or stop it; the same command then goes on."
        ) from None
    return lock


def _present() -> set[Path]:
    """What is in the directory of a run, if it has one."""
    here = Path.cwd()
    return set() if here == Path(to_absolute_path(".")) else {here, *here.rglob("*")}


def _clear(made: set[Path]) -> bool:
    """Remove what a run has made, with its directory, unless it has a row or a checkpoint."""
    start, here = Path(to_absolute_path(".")), Path.cwd()
    has_begun = any(KEPT & {*path.relative_to(here).parts} for path in made)
    if not has_begun:
        for path in sorted(made, reverse=True):
            path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()
        for folder in (here, *here.parents):
            if folder == start or any(folder.iterdir()):
                break
            folder.rmdir()
    return has_begun


def _versions() -> dict[str, Any]:
    versions: dict[str, Any] = {"python": platform.python_version(), "commit": _commit()}
    versions["platform"] = platform.platform()
    for package in RECORDED_PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return versions


def _commit() -> str:
    """That of the script's repository, with ``-dirty`` if files differ from it."""
    command = ["git", "--no-optional-locks", "describe", "--always", "--dirty", "--abbrev=40"]
    folder = Path(to_absolute_path(sys.argv[0])).parent
    with suppress(OSError):  # no git
        done = subprocess.run(
            [*command, "--exclude=*"], cwd=folder, capture_output=True, text=True, check=False
        )
        if done.returncode == 0:
            return done.stdout.strip()
    return "unknown"


def _write_json(path: Path, content: Mapping[str, object]) -> None:
    _write(path, json.dumps(content, indent=2) + "\n")


def _write(path: Path, text: str) -> None:
    """Write another file first, so that nobody sees a part, whenever the run is killed."""
    part = path.with_name(f"{path.name}.part")
    with part.open("w", newline="") as file:
        file.write(text)
    os.replace(part, path)
