"""Checkpoints of a run, and resuming from them: what ``docs/resuming.md`` promises to a user."""

from __future__ import annotations

import re
import shlex
import shutil
import signal
import sys
import threading
import time
from collections.abc import Sequence
from copy import deepcopy
from pathlib import Path
from types import FrameType, SimpleNamespace
from typing import Any, NoReturn

from hydra.core.override_parser.types import Quote, QuotedString
from hydra.utils import to_absolute_path
from omegaconf import DictConfig, OmegaConf
from torch import nn
from torchrl.checkpoint import Checkpoint, CheckpointError, GlobalRNGState

from torchrl_ecpo.checks import check_count
from torchrl_ecpo.experiment._files import StateFile, check_files, read_manifest, seal
from torchrl_ecpo.experiment.options import differences, flatten
from torchrl_ecpo.experiment.run import Run, command_line

__all__ = ["Checkpoints", "Progress", "restore_part"]

FOLDER = "checkpoints"
# A run that differs in these alone is the same run.
FREE_OPTIONS = {"resume", "checkpoint", "compile"}
# Useless once a run has finished, and most of its checkpoint.
ONLY_TO_GO_ON = {"replay_buffer"}
SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Progress(SimpleNamespace):
    """Counters of a script that its checkpoints hold; plain numbers, and lists of them.

    Examples:
        >>> progress = Progress(frames=0, returns=[])
        >>> progress.frames += 8
        >>> progress.state_dict()
        {'frames': 8, 'returns': []}
    """

    def state_dict(self) -> dict[str, Any]:
        """The counters, by name."""
        return deepcopy(vars(self))

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from saved counters."""
        vars(self).update(deepcopy(state_dict))


class Checkpoints:
    """The checkpoints of a run: written as it goes, when it is stopped, and at its end.

    Made before anything else of a run, it finds what ``config.resume`` asks for and refuses what
    cannot be resumed. :meth:`attach` then puts all parts of the run where they were, and
    :meth:`boundary` is called wherever the run may be interrupted. SIGTERM and SIGINT wait for the
    next boundary; a second one does not.

    Args:
        config: needs ``resume`` (None, a run directory or ``"auto"``) and ``checkpoint`` with
            ``interval`` (seconds from one checkpoint to the next; None: none but the last),
            ``max_share`` (of the time that writing may take: a longer one makes them rarer) and
            ``keep``, how many are kept.
        directory: of the run.

    Raises:
        CheckpointError: if there is nothing to resume from, if the last checkpoint is damaged or
            not of such a run, or if the configuration is not the checkpoint's.

    Examples:
        >>> import tempfile
        >>> options = {"interval": None, "max_share": 0.1, "keep": 2}
        >>> config = OmegaConf.create({"resume": None, "checkpoint": options})
        >>> checkpoints = Checkpoints(config, tempfile.mkdtemp())
        >>> checkpoints.source is None  # there is nothing to go on from
        True
    """

    def __init__(self, config: DictConfig, directory: Path | str = ".") -> None:
        self.options, self.resume = config.checkpoint, config.resume
        self.directory = Path(directory).resolve()
        self.folder = self.directory / FOLDER
        self.config: Any = OmegaConf.to_container(config, resolve=True)
        self.source = None if config.resume is None else self._find()
        self._stopped_by: signal.Signals | None = None
        self._handlers: dict[signal.Signals, Any] = {}

    def _find(self) -> Path | None:
        """The checkpoint to resume from."""
        given = self.resume
        if given != "auto" and Path(to_absolute_path(given)).resolve() != self.directory:
            raise CheckpointError(
                f"resume={given} is not this run's directory, {self.directory}. Leave out "
                "hydra.run.dir; to resume all runs of a sweep, give its hydra.sweep.dir and "
                "resume=auto."
            )
        source = self.latest
        if source is None and given != "auto":
            raise CheckpointError(
                f"resume={given}: there is nothing to resume from, for {self.folder} holds no "
                "checkpoint. Give the directory of a run that has written one, or leave out resume."
            )
        if source is None:
            print(f"resume=auto found no checkpoint: a new run begins in {self.directory}")
            return None
        try:
            manifest = read_manifest(source)
            self._saved = manifest["metadata"]
            differing = _differences(self._saved["config"], self.config)
            if differing:
                more = [f"and {len(differing) - 5} more"] * (len(differing) > 5)
                raise CheckpointError(
                    f"The configuration differs from that of {source}: "
                    f"{'; '.join([*differing[:5], *more])}. Resume with the options that the run "
                    "was started with, and the version of the script."
                )
            check_files(source, manifest)
        except OSError as error:
            raise CheckpointError(f"{source} cannot be read: {error}.") from error
        return source

    @property
    def latest(self) -> Path | None:
        """The last checkpoint, if there is one."""
        return (_paths(self.folder) or [None])[-1]

    def _remove(self, paths: Sequence[Path] = ()) -> None:
        """Remove checkpoints, none of which is ever seen in part, and what a kill has left."""
        for path in paths:
            path.rename(path.with_name(f".{path.name}"))
        for remains in self.folder.glob(".*checkpoint-*"):
            shutil.rmtree(remains, ignore_errors=True)

    def attach(self, run: Run, progress: Progress, **parts: Any) -> Checkpoints:
        """Say what a checkpoint holds, and resume from one if that was asked for.

        Args:
            run: the run, whose record is cut back to the checkpoint.
            progress: its counters, one of which has the name of the run's unit.
            parts: everything else, with ``state_dict()`` and ``load_state_dict()``; None is left
                out. The state of the global random generators is added.

        Raises:
            CheckpointError: if the checkpoint is damaged.
        """
        self.run, self.progress, self.parts = run, progress, parts
        # What is no count is refused here, before anything is removed.
        self._saved_step: int | None = self.step
        self.checkpoint = Checkpoint()
        parts = {"run": run, "progress": progress, "random": GlobalRNGState(), **parts}
        for name, part in parts.items():
            if part is not None:
                self.checkpoint.register(name, part, adapter=StateFile())
        if self.source is None:
            # Of a run that was here before, whose record will be gone.
            self._remove(_paths(self.folder))
            self._saved_step = None
        else:
            self._load(self.source)
            self._saved_step = self.step
        for part in (run, *self.parts.values()):
            if isinstance(part, Run):
                part.begin()
        self._saved_at, self._pause = time.monotonic(), 0.0
        return self

    @property
    def step(self) -> int:
        """Where the run stands, in its unit."""
        unit = self.run.unit
        return check_count(f"progress.{unit}", getattr(self.progress, unit), least=0)

    def _load(self, source: Path) -> None:
        metadata = self._saved
        names = set(self.checkpoint.components)
        if metadata["finished"]:
            left_out = names & ONLY_TO_GO_ON
            names -= left_out
            if left_out and metadata["step"] < self.config[f"total_{self.run.unit}"]:
                raise CheckpointError(
                    f"{source} is that of a run which had finished, and has no "
                    f"{', '.join(left_out)}: begin a longer run without resume."
                )
        try:
            # What is rebuilt may draw random numbers, so their generators come last.
            self.checkpoint.load(source, components=names - {"random"})
            self.checkpoint.load(source, components={"random"})
        except (CheckpointError, OSError) as error:
            raise CheckpointError(f"{source} cannot be restored: {error}") from error
        print(f"Resumed from {source}" + (", which had finished" if metadata["finished"] else ""))

    def boundary(self) -> None:
        """A moment at which the run may be interrupted; writes a checkpoint if one is due.

        Raises:
            SystemExit: after a checkpoint, if SIGTERM or SIGINT has come; 128 and its number.
        """
        if self._stopped_by is not None:
            self.save()
            self._leave(self._stopped_by)
        interval = self.options.interval
        waited = time.monotonic() - self._saved_at
        if interval is not None and waited >= max(interval, self._pause):
            self.save()

    def _leave(self, stopped_by: signal.Signals) -> NoReturn:
        print(f"Stopped by {stopped_by.name}. Resume with: {self.command}")
        raise SystemExit(128 + stopped_by)

    def save(self, *, finished: bool = False) -> None:
        """Write a checkpoint, unless the last one is of the same step.

        Raises:
            FloatingPointError: if a parameter is not finite.
            CheckpointError: if it cannot be written. Those before it are untouched.
        """
        # A name of its own: what is there is not replaced, so that there always is a checkpoint.
        path = self.folder / f"checkpoint-{self.step:012d}{'-finished' * finished}"
        if path.exists() or (self.step == self._saved_step and not finished):
            return
        self._check_parameters()
        started = time.monotonic()
        names = set(self.checkpoint.components) - (ONLY_TO_GO_ON if finished else set())
        written = path.with_name(f".{path.name}")
        try:
            self._remove()
            self.checkpoint.save(
                written,
                components=names,
                metadata={"config": self.config, "step": self.step, "finished": finished},
            )
            seal(written)
            written.rename(path)
            self._remove(_paths(self.folder)[: -1 if finished else -self.options.keep])
        except (OSError, RuntimeError, TypeError) as error:
            shutil.rmtree(written, ignore_errors=True)
            raise CheckpointError(
                f"The checkpoint at {self.run.unit} {self.step} could not be written: {error}. "
                f"The last good one is {self.latest}."
            ) from error
        self._saved_step, self._saved_at = self.step, time.monotonic()
        self._pause = (self._saved_at - started) / self.options.max_share

    def _check_parameters(self) -> None:
        for part, module in self.parts.items():
            for name, value in module.named_parameters() if isinstance(module, nn.Module) else ():
                if not value.isfinite().all():
                    raise FloatingPointError(
                        f"No checkpoint is written at {self.run.unit} {self.step}: {name} of "
                        f"{part} is not finite. The last good one is {self.latest}."
                    )

    @property
    def command(self) -> str:
        """What a user types to resume."""
        placed = ("resume=", "hydra.run.dir=")
        kept = [each for each in command_line() if not each.lstrip("+").startswith(placed)]
        directory = str(self.directory)
        if not re.fullmatch(r"[\w./-]+", directory):  # hydra has a meaning for commas, for one
            directory = QuotedString(directory, Quote.single).with_quotes()
        return shlex.join([*kept, f"resume={directory}"])

    def __enter__(self) -> Checkpoints:
        """Take over SIGTERM and SIGINT."""
        if threading.current_thread() is threading.main_thread():
            self._handlers = {name: signal.signal(name, self._stop) for name in SIGNALS}
        return self

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self._stopped_by = signal.Signals(number)
        self._restore_handlers()
        print(f"{self._stopped_by.name}: the run stops at the next checkpoint", file=sys.stderr)

    def _restore_handlers(self) -> None:
        for name, handler in self._handlers.items():
            signal.signal(name, handler)
        self._handlers = {}

    def __exit__(self, kind: Any, error: BaseException | None, traceback: Any) -> None:
        """Write a last checkpoint: at the end, if a worker died, and if a loss was not finite.

        All three are noticed before the parameters change, so that the state is still good.
        """
        self._restore_handlers()
        if error is None:
            self.save(finished=True)
        elif self.run.table.rows and isinstance(
            error, (ChildProcessError, FloatingPointError, ValueError)
        ):
            try:
                self.save()
            except (FloatingPointError, CheckpointError) as refused:
                print(refused, file=sys.stderr)
        # A signal to the whole group of processes ends the workers too.
        if isinstance(error, ChildProcessError) and self._stopped_by is not None:
            self._leave(self._stopped_by)


def _paths(folder: Path) -> list[Path]:
    """All checkpoints, the oldest first."""
    paths = sorted(folder.glob("checkpoint-*"))
    return [path for path in paths if re.fullmatch(r"checkpoint-\d+(-finished)?", path.name)]


def restore_part(directory: Path, name: str, part: Any) -> dict[str, Any]:
    """Put one part of a run, such as its loss module, where its last checkpoint has it.

    Args:
        directory: of the run.
        name: of the part.
        part: has ``load_state_dict()``.

    Returns:
        The configuration that the run was started with.

    Raises:
        CheckpointError: if there is no checkpoint, or none with that part, or if it is damaged.
    """
    found = _paths(directory / FOLDER)
    if not found:
        raise CheckpointError(f"{directory} has no checkpoint: is it the directory of a run?")
    manifest = read_manifest(found[-1])
    check_files(found[-1], manifest)
    checkpoint = Checkpoint()
    checkpoint.register(name, part, adapter=StateFile())
    checkpoint.load(found[-1], components={name})
    return manifest["metadata"]["config"]


def run_directory(resume: str | None, parent: str, name: str) -> str:
    """Where hydra starts a run: in a new directory, or in that of the run to resume.

    Args:
        resume: None, a run directory, or ``"auto"``: the last one in `parent` with a checkpoint.
        parent: of run directories, whose names sort by age.
        name: of a new run directory.
    """
    if resume is None:
        return f"{parent}/{name}"
    if resume == "auto":
        runs = sorted(path.parent for path in Path(parent).glob(f"*/{FOLDER}") if _paths(path))
        return str(runs[-1] if runs else Path(parent, name))
    return str(Path(resume).absolute())


OmegaConf.register_new_resolver("run_directory", run_directory, replace=True)


def _differences(saved: dict[str, Any], present: dict[str, Any]) -> list[str]:
    """What differs in two configurations, of a run or a stack, but for what may differ."""
    old, new = (
        {
            name: value
            for name, value in flatten(config).items()
            if not {*name.split(".")} & FREE_OPTIONS
        }
        for config in (saved, present)
    )
    for name in old.keys() & new.keys():
        # Nothing in a run depends on how long it is to be.
        if name.split(".")[-1].startswith("total_") and float(old[name]) < float(new[name]):
            old[name] = new[name]
    return list(differences(old, new).values())
