"""What is to be run: a manifest, checked, and expanded into cells of a method on a task."""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import yaml
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from torchrl_ecpo.experiment.options import compose_options, differences, flatten

HERE = Path(__file__).resolve().parent
SCRIPTS = HERE.parent
MANIFESTS = [HERE / "study.yaml", HERE / "search.yaml"]
KINDS = ("curves", "heat_map", "ranking")
RANKS = ("area", "final")
PLAN = {"options", "grid", "seeds", "script"}
# Runs that differ in these alone have the same numbers, as far as both go: the entries of env are
# those that other entries are or were read from, the last is how Q networks are called.
NOT_THE_RUN = (
    *("resume", "checkpoint", "logger", "threads", "compile", "stack", "stop_when"),
    *("env.settings", "env.optim", "env.cracked", "env.num_groups", "env.evaluation_interval"),
    "loss.options.deactivate_vmap",
)
# What a run had whose configuration lacks the entry: either the scripts no longer have it, and this
# is the one value that is left; or they have it only since, and this is how it was.
IMPLIED = {
    "env.head": "masked",  # the action's parts; independent factors and one softmax had no result
    "loss.length_normalised": False,  # of the entropy term of a lift; true had no result
    "env.distinct_histories": True,  # as TorchRL's LSTMModule has it; the same numbers, slower
    "env.hidden_size": 128,  # of the LSTM, which was the only policy
    "loss.score": "return",
    "loss.entropy": "nats",
    "policy.name": "lstm",
    "policy.window": "None",
    "policy.tables": False,
    "policy.hidden_size": 128,
    "epochs": 1,
    "max_kl": "None",
    "method.name": "ppo",
    "loss.width_entropy": 1.0,
    "loss.min_tau": 0.001,
    "loss.min_tau_prime": 0.003,
    "critic": "plain",
    # Of what is not learned, which had none.
    "optim.lr.log_tau": 0.01,
    "optim.lr.log_tau_prime": 0.0003,
    "optim.lr.value_network": 0.0003,
}

Entry = TypeVar("Entry")


@dataclass(frozen=True)
class Task:
    """What is solved, by which script, and how a run on it is judged."""

    name: str
    script: str
    """Below ``sota-implementations``."""
    steps: int
    metric: str
    options: str = ""
    """Of the script; by default ``env=`` and the task's name."""
    title: str = ""
    solved: float | None = None
    """Value of the metric at which the task counts as solved."""
    best: float | None = None
    """The metric of a perfect policy, by which scores of several tasks are made comparable."""


@dataclass(frozen=True)
class Study:
    """Methods on tasks, compared in one figure and one table."""

    name: str
    title: str
    tasks: tuple[str, ...]
    methods: Mapping[str, Mapping[str, Any]]
    """``options`` of the script, and perhaps a ``grid`` of values of further ones, or ``seeds`` or
    a ``script`` of its own. In a file, options alone may stand for the mapping."""
    seeds: tuple[int, ...]
    about: str = ""
    kind: str = "curves"
    rank_by: str = "area"
    """Of a ranking: the score by which settings are ordered."""
    steps: int | Mapping[str, int] | None = None
    """Instead of the task's; by task, or of all."""
    also: tuple[str, ...] = ()
    """Further metrics, each drawn in a figure of its own."""
    scale_by: str | None = None
    """Scores of several tasks are in units of this method's mean."""


@dataclass(frozen=True)
class Cell:
    """Runs that differ in nothing but the seed."""

    study: str
    task: Task
    method: str
    setting: tuple[tuple[str, str], ...]
    """Place in the method's grid: value by axis."""
    options: tuple[str, ...]
    seeds: tuple[int, ...]
    steps: int

    @property
    def label(self) -> str:
        """The setting in words; empty without a grid."""
        return ", ".join(f"{axis} {value}" for axis, value in self.setting)

    @property
    def name(self) -> str:
        """For messages."""
        return "/".join(filter(None, (self.task.name, self.method, self.label)))

    @property
    def script(self) -> Path:
        """The script that makes a run."""
        return SCRIPTS / self.task.script

    @property
    def config(self) -> DictConfig:
        """The script's configuration, but for the seed."""
        return _compose(self.script, self.options)

    @property
    def total_option(self) -> str:
        """The option that says how long a run is: ``total_frames`` or ``total_trajectories``."""
        return total_option(self.config)

    def identity(self, seed: int) -> dict[str, float | str]:
        """All that determines the numbers of a run."""
        config = self.config.copy()
        config.seed, config[self.total_option] = seed, self.steps
        return identity(config)

    def directory(self, runs: Path) -> Path:
        """Where the queue makes its runs; cells that are the same share it."""
        length = [f"{self.total_option}={self.steps}"] * length_counts(self.config)
        name = re.sub(r"[^\w.,+~-]+", "-", ",".join([*self.options, *length]))
        return runs / self.task.name / name


@cache
def _compose(script: Path, options: tuple[str, ...]) -> DictConfig:
    try:
        return compose_options(script.parent, options)
    except (ValueError, HydraException, OmegaConfBaseException) as error:
        raise ValueError(f"{script.name} {' '.join(options)} cannot be run: {error}") from error


def total_option(config: DictConfig) -> str:
    """The option that says how long a run is; its unit follows ``total_``."""
    for name in map(str, config):
        if name.startswith("total_"):
            return name
    raise ValueError("It is no configuration of one of the scripts: it has no total_ entry.")


def identity(config: DictConfig) -> dict[str, float | str]:
    """The entries of a configuration that determine the numbers of a run."""
    values = flatten(OmegaConf.to_container(config, resolve=True))
    with_length = length_counts(config)
    return {
        present(name): value
        for name, value in values.items()
        if not _is_below(name, NOT_THE_RUN)
        and (with_length or not name.split(".")[-1].startswith("total_"))
    }


def length_counts(config: DictConfig) -> bool:
    """Whether settings fall until the end of a run, as those of ``sb3.py`` over frames may."""
    is_dqn = OmegaConf.select(config, "method.name") == "dqn"
    return "total_frames" in config and bool(is_dqn or config.get("linear"))


def changed_entries(
    old: Mapping[str, object], new: Mapping[str, object], ignored: Sequence[str] = ()
) -> list[str]:
    """What differs between two runs, in words; but for `NOT_THE_RUN` and entries that are ignored.

    Examples:
        >>> changed_entries({"tau": 0.5, "a.b": 1}, {"tau": 0.1}, ignored=["a"])
        ['tau was 0.5, is 0.1']
    """
    old, new = (
        {**IMPLIED, **{present(k): v for k, v in run.items() if not _is_below(k, NOT_THE_RUN)}}
        for run in (old, new)
    )
    changes = differences(old, new)
    return [words for name, words in changes.items() if not _is_below(name, ignored)]


@cache
def present(text: str) -> str:
    """What names an option, or several, as when a run was made, with the names of today.

    Examples:
        >>> present("loss=ecac loss.options.tau=0.1 ~loss.lr.log_tau")
        'loss=ecac loss.tau=0.1'
    """
    text = re.sub(r" ~\S+", "", text)  # learning rates of what is not learned, which may stay now
    for old, new in _former_names().items():
        text = re.sub(rf"(?<![\w.]){re.escape(old)}(?=[.= ]|$)", new, text)
    return text


@cache
def _former_names() -> dict[str, str]:
    """Of each script, what its ``options.yaml`` says ``now ...``."""
    kinds = [yaml.safe_load(file.read_text()) for file in sorted(SCRIPTS.glob("*/options.yaml"))]
    return {
        old: kind.removeprefix("now ")
        for own in kinds
        for old, kind in own.items()
        if kind.startswith("now ")
    }


def _is_below(name: str, entries: Iterable[str]) -> bool:
    return any(f"{name}.".startswith(f"{entry}.") for entry in entries)


@dataclass(frozen=True)
class Manifest:
    """What one or several files say, by name."""

    tasks: dict[str, Task] = dataclasses.field(default_factory=dict)
    studies: dict[str, Study] = dataclasses.field(default_factory=dict)

    def cells(self, study: Study) -> list[Cell]:
        """All cells of a study, task by task."""
        return [
            Cell(
                study=study.name,
                task=dataclasses.replace(task, script=plan.get("script", task.script)),
                method=method,
                setting=setting,
                options=(*shlex.split(task.options or f"env={task.name}"), *options),
                seeds=parse_seeds(plan["seeds"]) if "seeds" in plan else study.seeds,
                steps=_steps_of(study, task),
            )
            for task in (self.tasks[name] for name in study.tasks)
            for method, plan in study.methods.items()
            for setting, options in _settings(plan)
        ]

    def select(
        self,
        only: Sequence[str] = (),
        tasks: Sequence[str] = (),
        methods: Sequence[str] = (),
        seeds: Iterable[int] = (),
    ) -> list[Cell]:
        """The cells of some studies, tasks, methods and seeds; of all, where none is named.

        Raises:
            ValueError: for a name that the manifest does not have, and if nothing is left.
        """
        cells = [cell for study in self.studies.values() for cell in self.cells(study)]
        _check_names("--only", only, self.studies)
        _check_names("--tasks", tasks, {cell.task.name for cell in cells})
        _check_names("--methods", methods, {cell.method for cell in cells})
        wanted = set(seeds)
        selected = [
            dataclasses.replace(cell, seeds=own)
            for cell in cells
            for own in [tuple(seed for seed in cell.seeds if not wanted or seed in wanted)]
            if own
            and (not only or cell.study in only)
            and (not tasks or cell.task.name in tasks)
            and (not methods or cell.method in methods)
        ]
        if not selected:
            raise ValueError("No run is left by this choice of names and seeds.")
        return selected


def _steps_of(study: Study, task: Task) -> int:
    own = study.steps
    return (own.get(task.name) if isinstance(own, Mapping) else own) or task.steps


def _settings(
    plan: Mapping[str, Any],
) -> list[tuple[tuple[tuple[str, str], ...], tuple[str, ...]]]:
    """The settings of a method, and the options of each; without a grid there is one."""
    axes = [
        [
            (str(axis), str(value), shlex.split(options[value]) if named else [f"{axis}={value}"])
            for value in options
        ]
        for axis, options in plan.get("grid", {}).items()
        for named in [isinstance(options, Mapping)]
    ]
    return [
        (
            tuple((axis, value) for axis, value, _ in point),
            (*shlex.split(plan["options"]), *(o for *_, options in point for o in options)),
        )
        for point in itertools.product(*axes)
    ]


def parse_seeds(given: str | int | Sequence[int]) -> tuple[int, ...]:
    """Seeds from ``"1-3,7"``, a number or a list of numbers.

    Raises:
        ValueError: for anything else.

    Examples:
        >>> parse_seeds("1-3,7")
        (1, 2, 3, 7)
    """
    parts = given if isinstance(given, Sequence) else [given]
    parts = given.split(",") if isinstance(given, str) else parts
    seeds: list[int] = []
    for part in map(str, parts):
        bounds = re.fullmatch(r"\s*(\d+)(?:-(\d+))?\s*", part)
        if bounds is None:
            raise ValueError(f"Seeds are written like 1-3,7 or [1, 2, 3, 7], got {given!r}.")
        first, last = int(bounds[1]), int(bounds[2] or bounds[1])
        if last < first:
            raise ValueError(f"Seeds are counted upwards, got {part!r}.")
        seeds += range(first, last + 1)
    if not seeds or len(set(seeds)) < len(seeds):
        raise ValueError(f"Seeds must be there, and none twice, got {given!r}.")
    return tuple(seeds)


def read_manifests(paths: Sequence[Path] = MANIFESTS) -> Manifest:
    """Read and check manifests; studies may name the tasks of files before theirs.

    Raises:
        ValueError: if a file is no manifest; the message names the entry.
    """
    manifest = Manifest()
    sections = {field.name for field in dataclasses.fields(Manifest)}
    for path in paths:
        content = yaml.safe_load(path.read_text())
        if not isinstance(content, Mapping) or not set(content) <= sections:
            raise ValueError(f"{path} must be a mapping with {sorted(sections)} and nothing else.")
        for name, entry in content.get("tasks", {}).items():
            _add(manifest.tasks, path, _read_task(f"{path}, task {name}", name, entry))
        for name, entry in content.get("studies", {}).items():
            study = _read_study(f"{path}, study {name}", name, entry, manifest.tasks)
            _add(manifest.studies, path, study)
    return manifest


def _add(known: dict[str, Any], path: Path, entry: Any) -> None:
    if entry.name in known:
        raise ValueError(f"{path}: {entry.name} is there twice.")
    known[entry.name] = entry


def _read_task(where: str, name: str, entry: object) -> Task:
    task = _read(Task, where, name, entry)
    _check_steps(where, task.steps)
    _check_script(where, task.script)
    return task


def _check_script(where: str, script: str) -> None:
    if not (SCRIPTS / script).is_file():
        raise ValueError(f"{where}: there is no script {script} in {SCRIPTS.name}.")


def _read_study(where: str, name: str, entry: object, tasks: Mapping[str, Task]) -> Study:
    study = _read(Study, where, name, entry)
    for field in ("tasks", "also"):
        if isinstance(getattr(study, field), str):
            raise ValueError(f"{where}: {field} must be a list, got {getattr(study, field)!r}.")
    if not isinstance(study.methods, Mapping):
        raise ValueError(f"{where}: methods must be a mapping, got {study.methods!r}.")
    plans = {m: {"options": p} if isinstance(p, str) else p for m, p in study.methods.items()}
    try:
        study = dataclasses.replace(
            study,
            methods=plans,
            seeds=parse_seeds(study.seeds),
            tasks=tuple(study.tasks),
            also=tuple(study.also),
        )
        _check_names("tasks", study.tasks, tasks)
        _check_names("scale_by", [study.scale_by] if study.scale_by else [], study.methods)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    if study.kind not in KINDS:
        raise ValueError(f"{where}: kind must be one of {KINDS}, got {study.kind!r}.")
    if study.rank_by not in RANKS:
        raise ValueError(f"{where}: rank_by must be one of {RANKS}, got {study.rank_by!r}.")
    if isinstance(study.steps, Mapping):
        _check_names("steps", study.steps, study.tasks)
    steps = study.steps.values() if isinstance(study.steps, Mapping) else [study.steps]
    for number in steps:
        if number is not None:
            _check_steps(where, number)
    for method, plan in study.methods.items():
        if not isinstance(plan, Mapping) or not {"options"} <= set(plan) <= PLAN:
            raise ValueError(
                f"{where}: method {method} must be options of the script, or a mapping with "
                f"options and grid, seeds or script, got {plan!r}."
            )
        if "script" in plan:
            _check_script(where, plan["script"])
        if study.kind == "curves" and "grid" in plan:
            raise ValueError(
                f"{where}: method {method} has a grid, which needs kind: ranking or heat_map."
            )
        if study.kind == "heat_map" and len(plan.get("grid", ())) != 2:
            raise ValueError(f"{where}: a heat map needs a grid of two axes, method {method}.")
    return study


def _read(kind: type[Entry], where: str, name: str, entry: object) -> Entry:
    fields = {field.name: field for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    del fields["name"]
    if not isinstance(entry, Mapping):
        raise ValueError(f"{where} must be a mapping with {sorted(fields)}, got {entry!r}.")
    unknown = set(entry) - set(fields)
    required = {key for key, field in fields.items() if field.default is dataclasses.MISSING}
    if unknown:
        raise ValueError(f"{where}: unknown {sorted(unknown)}; there are {sorted(fields)}.")
    if required - set(entry):
        raise ValueError(f"{where}: {sorted(required - set(entry))} must be given.")
    return kind(**{"name": name, **entry})


def _check_steps(where: str, steps: object) -> None:
    if not isinstance(steps, int) or steps < 1:
        raise ValueError(f"{where}: steps must be an integer of at least 1, got {steps!r}.")


def _check_names(option: str, given: Iterable[str], known: Iterable[str]) -> None:
    unknown = [name for name in given if name not in set(known)]
    if unknown:
        raise ValueError(f"{option}: unknown {unknown}; there are {sorted(known)}.")


def argument_parser(description: str | None) -> argparse.ArgumentParser:
    """A parser of what queue, collection and report have in common."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--manifest", type=Path, nargs="+", default=MANIFESTS)
    return parser


def add_studies(parser: argparse.ArgumentParser) -> None:
    """Let a user choose among the studies."""
    parser.add_argument("--only", type=_names, default=[], help="studies: figure1,figure2")


def add_ignored(parser: argparse.ArgumentParser) -> None:
    """Let a user take runs whose configuration lacks what has been added since."""
    parser.add_argument(
        "--ignore",
        type=_names,
        default=[],
        help="entries of a configuration that make no difference: collector,loss.new",
    )


def _names(given: str) -> list[str]:
    return [name.strip() for name in given.split(",")]


def _seeds(given: str) -> tuple[int, ...]:
    try:
        return parse_seeds(given)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def add_selection(parser: argparse.ArgumentParser) -> None:
    """Let a user choose among the studies, and among the runs of each."""
    add_studies(parser)
    parser.add_argument("--tasks", type=_names, default=[], help="copy,reverse")
    parser.add_argument("--methods", type=_names, default=[], help="ECPO,UREX")
    parser.add_argument("--seeds", type=_seeds, default=(), help="1-3,7")
