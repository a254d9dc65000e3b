"""The options of a script, checked against its defaults before hydra makes a run directory.

Nothing here imports torch, so that ``--help`` and most refusals come at once.
"""

from __future__ import annotations

import itertools
import json
import math
import operator
import re
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from difflib import SequenceMatcher
from functools import cache
from pathlib import Path
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from hydra.main import get_args_parser  # pyright: ignore[reportPrivateImportUsage]
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

__all__ = ["check_command_line", "compose_options", "expand", "parse"]

_LIMITS = {">=": operator.ge, "<=": operator.le, ">": operator.gt, "<": operator.lt}
_EXPONENTIAL = re.compile(r"(?<![\w./'\"-])\d+(?:\.\d+)?[eE]\+?\d+(?![\w./])")
_FLAGS = "--multirun: each combination of seed=0,1 loss=ecpo,ment; --hydra-help: further flags"

Check = Callable[[DictConfig, Sequence[str]], object]


def check_command_line(script: str, check: Check | None = None) -> None:
    """Answer ``--help``, and refuse a command line that is wrong, before anything is made.

    A script calls it first without `check`, and once more when all is imported that `check` needs.

    Args:
        script: its path.
        check: what else is to be checked of each run: of its configuration, and of the options that
            it is composed of. Raises ValueError.

    Raises:
        SystemExit: naming each option that is wrong, what was expected, and what came.
    """
    sys.argv[1:] = map(_whole, sys.argv[1:])
    flags = get_args_parser().parse_args()
    if any((flags.hydra_help, flags.cfg, flags.info, flags.shell_completion)):
        return  # nothing is run
    options, folder = flags.overrides, Path(script).resolve().parent
    name = flags.config_name or "config"
    if flags.config_dir:
        options.append(f"hydra.searchpath=['{Path(flags.config_dir).absolute()}']")
    problems: dict[str, None] = {}  # of several runs, each once
    with _noting(problems), _initialized(folder / (flags.config_path or "config")):
        if not (flags.multirun or flags.help or "hydra.mode=MULTIRUN" in options):
            for line in [str(own.input_line) for own in parse(options) if own.is_sweep_override()]:
                problems[f"{line} is several runs: add --multirun. A list is in brackets."] = None
        for own in parse(options):
            if own.key_or_group == "hydra.job.chdir" and own.value() is False:
                problems[
                    "hydra.job.chdir=false would write runs to the working directory, over each "
                    "other. Leave it out."
                ] = None
        for run in [options] if flags.help else expand(options):
            with _noting(problems):
                config = compose_options(folder, run, name)
                if flags.help:
                    print(_help(folder / "config", config, options, name))
                    raise SystemExit
                resume = config.get("resume")
                if resume not in (None, "auto") and not Path(resume).is_dir():
                    raise ValueError(f"resume={resume}: there is no such directory.")
                if check is not None:
                    check(config, run)
    if problems:
        raise SystemExit("\n".join(f"{Path(script).name}: {problem}" for problem in problems))


@contextmanager
def _noting(problems: dict[str, None]) -> Iterator[None]:
    try:
        yield
    except (ValueError, ImportError) as error:
        problems |= dict.fromkeys(str(error).splitlines())
    except (HydraException, OmegaConfBaseException) as error:
        # Of hydra's lines without where it looked, and its advice to add a group or to read on.
        message = re.split(r"\n(?:Config search path|To append|See https)", str(error))[0]
        if isinstance(error, OverrideParseException):
            reason = message.splitlines()[-1]
            message = f"{error.override} cannot be read as NAME=VALUE: {reason}."
        problems[" ".join(message.split())] = None


def _initialized(config: Path) -> Any:
    return initialize_config_dir(str(config), version_base="1.3")


def parse(options: Sequence[str]) -> list[Override]:
    """What hydra reads in a command line."""
    running = GlobalHydra.instance()
    loader = running.config_loader() if running.is_initialized() else None
    return OverridesParser.create(loader).parse_overrides(list(options))


def expand(options: Sequence[str]) -> list[list[str]]:
    """Every combination of the values that options are given, as hydra's ``--multirun`` has it.

    Examples:
        >>> expand(["loss=ecpo", "seed=0,1"])
        [['loss=ecpo', 'seed=0'], ['loss=ecpo', 'seed=1']]
    """
    choices = [
        [f"{own.get_key_element()}={value}" for value in own.sweep_string_iterator()]
        if own.is_sweep_override()
        else [str(own.input_line)]
        for own in parse(options)
    ]
    return [list(run) for run in itertools.product(*choices)]


def compose_options(folder: Path, options: Sequence[str], name: str = "config") -> DictConfig:
    """Compose the configuration of a run, and check its options.

    The defaults are those of the groups that are chosen, such as ``env=`` and ``loss=``. By default
    ``true`` stands for a flag, ``1`` for an integer of at least 1 (``0``: of at least 0), ``1.0``
    for a number of at least 0, and null for anything. What else options take is in
    ``options.yaml``, by name: kinds and words, with ``or`` between them. A kind is ``an integer``
    or ``a number``, with limits (``a number > 0 and <= 1``), ``text``, ``a mapping``,
    ``a schedule`` or ``anything``; a word is taken as it is (``null``). ``now NAME`` says what an
    option is called that had another name.

    Args:
        folder: of the script, with ``config/`` and, where needed, ``options.yaml``.
        options: the command line.
        name: of the configuration.

    Raises:
        ValueError: for options that do not exist, or whose value is of another kind, with a line
            for each: the option, what was expected, and what came.
        HydraException: for what hydra refuses.
    """
    file, options = folder.resolve() / "options.yaml", [*map(_whole, options)]
    kinds: Any = OmegaConf.to_container(OmegaConf.load(file)) if file.is_file() else {}
    is_running = GlobalHydra.instance().is_initialized()  # within hydra.main
    with nullcontext() if is_running else _initialized(file.parent / "config"):
        groups = GlobalHydra.instance().config_loader().list_groups("")
        chosen, values, problems = [], [], []
        for own in parse(options):
            key, line = own.key_or_group, str(own.input_line)
            if (present := renamed(key, kinds)) != key:
                problems.append(f"{key} is called {present}.")
            elif key in groups or key.startswith("hydra"):
                chosen.append(line)
            else:
                values.append(line)
        try:
            defaults = _defaults(file, name, tuple(chosen))
        except MissingConfigException:
            absent = [*_absent(chosen)]
            if not absent:
                raise
            raise ValueError("\n".join([*problems, *absent])) from None
        try:
            config = compose(name, [*chosen, *values]) if values else defaults
        except HydraException:
            # What it does not know it advises to add.
            added = [f"++{line.lstrip('+')}" for line in values if line[0] != "~"]
            config = compose(name, [*chosen, *added])
            problems += _problems(config, defaults, kinds, groups)
            if not problems:
                raise
        else:
            problems += _problems(config, defaults, kinds, groups)
        if problems:
            raise ValueError("\n".join(problems))
        return config


def _absent(chosen: Sequence[str]) -> Iterator[str]:
    """What is chosen of a group that does not have it, in a line each."""
    loader: Any = GlobalHydra.instance().config_loader()
    search = [line for line in chosen if line.startswith("hydra.searchpath=")]
    for own in parse(chosen):
        group, value = own.key_or_group, own.value()
        choices = loader.get_group_options(group, overrides=search)
        if choices and isinstance(value, str) and value not in choices:
            yield f"There is no {group}={value}; there are {', '.join(choices)}."


def renamed(name: str, kinds: Mapping[str, str]) -> str:
    """The present name of an option: of what ``options.yaml`` says ``now ...``, that.

    Examples:
        >>> renamed("loss.options.tau", {"loss.options": "now loss"})
        'loss.tau'
    """
    for old, kind in kinds.items():
        if kind.startswith("now ") and f"{name}.".startswith(f"{old}."):
            return kind.removeprefix("now ") + name.removeprefix(old)
    return name


def _whole(option: str) -> str:
    """An option in which 1e4 is an integer, as no number that hydra reads with an exponent is."""

    def written(number: re.Match[str]) -> str:
        value = float(number[0])
        return str(int(value)) if value.is_integer() else number[0]

    return _EXPONENTIAL.sub(written, option)


@cache
def _defaults(file: Path, name: str, chosen: tuple[str, ...]) -> DictConfig:
    """What a study composes again and again: for a script, by the file that is beside it."""
    return compose(name, list(chosen))


def _problems(
    config: DictConfig, defaults: DictConfig, kinds: Mapping[str, str], groups: Collection[str]
) -> Iterator[str]:
    """All that is wrong, in a line each."""
    config, defaults = config.copy(), defaults.copy()
    unresolved = (flatten(OmegaConf.to_container(each)) for each in (config, defaults))
    missing, usual = ({name for name in each if each[name] == "???"} for each in unresolved)
    for name in sorted(missing):
        yield f"{name} must be given."
        OmegaConf.update(config, name, None)
    for name in usual:  # which may say what others are
        OmegaConf.update(defaults, name, OmegaConf.select(config, name))
    given, usual = (OmegaConf.to_container(each, resolve=True) for each in (config, defaults))
    names = [name.split(".") for name in flatten(usual)]
    known = [".".join(parts[: i + 1]) for parts in names for i in range(len(parts))]
    kinds = {**kinds, **dict.fromkeys(missing, "anything")}
    yield from _problems_below("", given, usual, kinds, [*known, *groups])


def _problems_below(
    parent: str, values: Any, defaults: Any, kinds: Mapping[str, str], known: Collection[str]
) -> Iterator[str]:
    """Of the entries of a mapping; without defaults, it has those that have a kind."""
    named = [name.removeprefix(parent) for name in kinds if name.startswith(parent)]
    usual = dict.fromkeys(named) if defaults is None else defaults
    for key in {**usual, **values}:
        name = f"{parent}{key}"
        if key not in usual:
            for wrong in flatten(values[key], f".{name}"):
                nearest = max(known, key=lambda other, wrong=wrong: _likeness(wrong, other))
                yield f"There is no option {wrong}; the nearest one is {nearest}."
        elif key in values:
            yield from _problems_of(name, values[key], usual[key], kinds, known)
        else:
            yield f"{name} must be given."


def _problems_of(
    name: str, value: Any, default: Any, kinds: Mapping[str, str], known: Collection[str]
) -> Iterator[str]:
    kind = kinds.get(name) or _kind_of(default)
    fitting = [one for one in kind.split(" or ") if _fits(value, one)]
    if not fitting:
        yield f"{name} must be {kind}, got {value!r}."
    elif fitting[0] == "a mapping":
        yield from _problems_below(f"{name}.", value, default, kinds, known)
    elif fitting[0] == "a schedule" and value != default:
        from torchrl_ecpo.schedules import make_schedule  # with torch

        for key in value.keys() - {"schedule"}:
            yield from _problems_of(f"{name}.{key}", value[key], 0.0, {}, known)
        try:
            make_schedule(value)
        except ValueError as error:
            yield f"{name}: {error}"
    elif fitting[0] == "a list" and default:
        usual = default[0] if isinstance(default, list) else default  # of either, such as a clip
        for index, item in enumerate(value):
            yield from _problems_of(f"{name}[{index}]", item, usual, kinds, known)


def _kind_of(default: Any) -> str:
    if isinstance(default, (int, float)) and not isinstance(default, bool):
        is_count = isinstance(default, int)
        return f"an integer >= {min(1, default)}" if is_count else f"a number >= {min(0, default)}"
    usual = {bool: "true or false", str: "text", dict: "a mapping", list: "a list"}
    return usual.get(type(default), "anything")


def _fits(value: Any, kind: str) -> bool:
    types = {"integer": int, "number": (int, float), "text": str, "list": list}
    types |= {"mapping": dict, "schedule": dict, "anything": object}
    word, *limits = kind.removeprefix("an ").removeprefix("a ").split()
    if word not in types:
        constants = {"true": True, "false": False, "null": None}
        return value is constants[word] if word in constants else value == word
    if word in ("integer", "number") and isinstance(value, bool):
        return False
    if isinstance(value, float) and not math.isfinite(value):
        return False
    bounds = zip(limits[::3], map(float, limits[1::3]), strict=True)  # the third of three is "and"
    return isinstance(value, types[word]) and all(_LIMITS[sign](value, at) for sign, at in bounds)


def _likeness(name: str, other: str) -> float:
    """How alike two names are, and what they end in."""
    pairs = ((name, other), (name.split(".")[-1], other.split(".")[-1]))
    return sum(SequenceMatcher(None, *pair).ratio() for pair in pairs)


def flatten(config: object, prefix: str = "") -> dict[str, float | str]:
    """A nested configuration as ``{"loss.tau": 0.5, ...}``, which is all TensorBoard takes."""
    if isinstance(config, Mapping):
        parts = (flatten(value, f"{prefix}.{name}") for name, value in config.items())
        return {name: value for part in parts for name, value in part.items()}
    is_plain = isinstance(config, (bool, int, float, str))
    return {prefix.removeprefix("."): config if is_plain else str(config)}


def differences(old: Mapping[str, object], new: Mapping[str, object]) -> dict[str, str]:
    """What differs between two flat configurations, in words, by the name of the entry.

    Examples:
        >>> differences({"tau": 0.5, "a.b": 1}, {"tau": 0.1, "a.b": 1})
        {'tau': 'tau was 0.5, is 0.1'}
    """
    return {
        name: f"{name} was {old.get(name, 'absent')}, is {new.get(name, 'absent')}"
        for name in sorted(old.keys() | new.keys())
        if name not in old or name not in new or old[name] != new[name]
    }


# -------------------------------------------------------------------------------------------- help


def _help(configs: Path, config: DictConfig, options: Sequence[str], name: str) -> str:
    """What ``--help`` prints: the choices, and each option as it is with those that are made."""
    lines = [_comment(configs / f"{name}.yaml", whole=True)]
    for group in sorted(path for path in configs.iterdir() if [*path.glob("*.yaml")]):
        lines += ["", f"{group.name}="]
        lines += [f"  {path.stem:18} {_comment(path)}" for path in sorted(group.glob("*.yaml"))]
    words, rows = _words(configs, options, name), _rows(OmegaConf.to_container(config))
    lines += ["", "Options, as they are with these choices:"]
    lines += [f"  {f'{key}={value}':42} {words.get(key, '')}".rstrip() for key, value in rows]
    return "\n".join([*lines, "", _FLAGS])


def _comment(file: Path, *, whole: bool = False) -> str:
    """The first line of what a configuration says of itself, or all."""
    lines = file.read_text().removeprefix("# @package _global_\n").splitlines()
    comment = [*itertools.takewhile(lambda line: line.startswith("#"), lines)]
    return "\n".join(line[2:] for line in (comment if whole else comment[:1]))


def _words(configs: Path, options: Sequence[str], name: str) -> dict[str, str]:
    """What is said of options in the files that a configuration is composed of."""
    loader: Any = GlobalHydra.instance().config_loader()
    words: dict[str, str] = {}
    for default in loader.compute_defaults_list(name, list(options), RunMode.RUN).defaults:
        file = configs / f"{default.config_path}.yaml"
        if file.is_file():
            parent = "" if default.package in ("", "_global_") else f"{default.package}."
            words |= {f"{parent}{key}": word for key, word in words_of(file).items()}
    return words


def words_of(file: Path) -> dict[str, str]:
    """The comment behind each option of a file, on its line."""
    text = file.read_text()
    lines = text.splitlines()
    words = {key: lines[at].partition(" # ")[2] for key, at in _lines(yaml.compose(text))}
    return {key: word for key, word in words.items() if word}


def _lines(node: Any) -> Iterator[tuple[str, int]]:
    """The names in a mapping, and below, and the lines on which they are."""
    for key, value in node.value if isinstance(node, yaml.MappingNode) else ():
        yield key.value, key.start_mark.line
        yield from ((f"{key.value}.{name}", line) for name, line in _lines(value))


def _rows(config: Any, parent: str = "") -> Iterator[tuple[str, str]]:
    for key, value in config.items():
        if isinstance(value, dict) and not value.keys() & {"schedule", "metric"}:  # one value
            yield from _rows(value, f"{parent}{key}.")
        else:
            yield f"{parent}{key}", _written(value)


def _written(value: Any) -> str:
    """A value as it is typed."""
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{_written(own)}" for key, own in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ",".join(map(_written, value)) + "]"
    return value if isinstance(value, str) else json.dumps(value)
