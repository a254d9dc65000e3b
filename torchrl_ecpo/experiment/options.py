"""The options of a script, checked against its defaults before hydra makes a run directory."""

from __future__ import annotations

import itertools
import math
import operator
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import nullcontext
from difflib import SequenceMatcher
from functools import cache
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from hydra.main import get_args_parser  # pyright: ignore[reportPrivateImportUsage]
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from torchrl_ecpo.experiment.run import flatten
from torchrl_ecpo.schedules import make_schedule

__all__ = ["check_command_line", "check_options", "compose_options", "expand", "parse"]

_LIMITS = {">=": operator.ge, "<=": operator.le, ">": operator.gt, "<": operator.lt}


def check_command_line(script: str, check: Callable[[DictConfig, Sequence[str]], object]) -> None:
    """Refuse a command line that is wrong, as the first thing that a script does.

    Args:
        script: its path.
        check: what else is to be checked of each run: of its configuration, and of the options that
            it is composed of. Raises ValueError.

    Raises:
        SystemExit: naming the option, what was expected, and what came.
    """
    flags = get_args_parser().parse_args()
    if any((flags.help, flags.hydra_help, flags.cfg, flags.info, flags.shell_completion)):
        return  # nothing is run
    options, folder = flags.overrides, Path(script).resolve().parent
    if flags.config_dir:
        options.append(f"hydra.searchpath=['{Path(flags.config_dir).absolute()}']")
    try:
        with _initialized(folder / (flags.config_path or "config")):
            for run in expand(options):
                check(compose_options(folder, run, flags.config_name or "config"), run)
    except (ValueError, HydraException, OmegaConfBaseException) as error:
        # Of hydra's lines without where it looked, and its advice to add a group.
        message = re.split(r"\n(?:Config search path|To append)", str(error))[0]
        raise SystemExit(f"{Path(script).name}: {' '.join(message.split())}") from None


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
    """Compose the configuration of a run, and check it by :func:`check_options`.

    The defaults are those of the groups that are chosen, such as ``env=`` and ``loss=``. What
    options take that are of more than one kind, or within limits, is in ``options.yaml``.

    Args:
        folder: of the script, with ``config/`` and, where needed, ``options.yaml``.
        options: the command line.
        name: of the configuration.

    Raises:
        ValueError: for an option that does not exist, or whose value is of another kind.
        HydraException: for what hydra refuses.
    """
    file = folder.resolve() / "options.yaml"
    kinds: Any = OmegaConf.to_container(OmegaConf.load(file)) if file.is_file() else {}
    is_running = GlobalHydra.instance().is_initialized()  # within hydra.main
    with nullcontext() if is_running else _initialized(file.parent / "config"):
        groups = GlobalHydra.instance().config_loader().list_groups("")
        chosen, values = [], []
        for own in parse(options):
            is_choice = own.key_or_group in groups or own.key_or_group.startswith("hydra")
            (chosen if is_choice else values).append(str(own.input_line))
        defaults = _defaults(file, name, tuple(chosen))
        try:
            config = compose(name, list(options))
        except HydraException:
            # What it does not know it advises to add.
            added = [line if line[0] == "~" else f"++{line.lstrip('+')}" for line in values]
            check_options(compose(name, [*chosen, *added]), defaults, kinds, groups)
            raise
        check_options(config, defaults, kinds, groups)
        return config


@cache
def _defaults(file: Path, name: str, chosen: tuple[str, ...]) -> DictConfig:
    """What a study composes again and again: for a script, by the file that is beside it."""
    return compose(name, list(chosen))


def check_options(
    config: DictConfig,
    defaults: DictConfig,
    kinds: Mapping[str, str],
    groups: Collection[str] = (),
) -> None:
    """Refuse options that do not exist or whose value is not of the kind of the default.

    By default ``true`` stands for a flag, ``1`` for an integer of at least 1 (``0``: of at least
    0), ``1.0`` for a number of at least 0, and null for anything.

    Args:
        config: of a run.
        defaults: the same without what a user has changed.
        kinds: what else options take, by name: kinds and words, with ``or`` between them. A kind is
            ``an integer`` or ``a number``, with limits (``a number > 0 and <= 1``), ``text``,
            ``a mapping``, ``a schedule`` or ``anything``; a word is taken as it is (``null``).
            ``nothing`` says that the option may be missing.
        groups: further names that a user may have meant.

    Raises:
        ValueError: naming the option, what was expected, and what came.

    Examples:
        >>> defaults = OmegaConf.create({"compile": False, "optim": {"lr": 0.1}})
        >>> config = OmegaConf.create({"compile": "no", "optim": {"lr": 0.1}})
        >>> check_options(config, defaults, {})
        Traceback (most recent call last):
            ...
        ValueError: compile must be true or false, got 'no'.
        >>> config = OmegaConf.create({"compile": False, "optim": {"lr": 0.1, "learnrate": 1}})
        >>> check_options(config, defaults, {"optim.lr": "a number > 0"})
        Traceback (most recent call last):
            ...
        ValueError: There is no option optim.learnrate; the nearest one is optim.lr.
    """
    defaults = defaults.copy()
    unresolved = (flatten(OmegaConf.to_container(each)) for each in (config, defaults))
    given, usual = ({name for name in each if each[name] == "???"} for each in unresolved)
    if given:
        raise ValueError(f"{min(given)} must be given.")
    for name in usual:  # which may say what others are
        OmegaConf.update(defaults, name, OmegaConf.select(config, name))
    given, usual = (OmegaConf.to_container(each, resolve=True) for each in (config, defaults))
    names = [name.split(".") for name in flatten(usual)]
    known = [".".join(parts[: i + 1]) for parts in names for i in range(len(parts))]
    _check_below("", given, usual, kinds, [*known, *groups])


def _check_below(
    parent: str, values: Any, defaults: Any, kinds: Mapping[str, str], known: Collection[str]
) -> None:
    """Check the entries of a mapping; without defaults, it has those that have a kind."""
    named = [name.removeprefix(parent) for name in kinds if name.startswith(parent)]
    usual = dict.fromkeys(named) if defaults is None else defaults
    for key in {**usual, **values}:
        name = f"{parent}{key}"
        may_be_absent = kinds.get(name, "").endswith("or nothing")
        if key not in usual and not may_be_absent:
            wrong = next(iter(flatten(values[key], f".{name}")))
            nearest = max(known, key=lambda other: _likeness(wrong, other))
            raise ValueError(f"There is no option {wrong}; the nearest one is {nearest}.")
        if key in values:
            _check(name, values[key], usual.get(key), kinds, known)
        elif not may_be_absent:
            raise ValueError(f"{name} must be given.")


def _check(
    name: str, value: Any, default: Any, kinds: Mapping[str, str], known: Collection[str]
) -> None:
    kind = kinds.get(name) or _kind_of(default)
    fitting = [one for one in kind.split(" or ") if _fits(value, one)]
    if not fitting:
        raise ValueError(f"{name} must be {kind}, got {value!r}.")
    if fitting[0] == "a mapping":
        _check_below(f"{name}.", value, default, kinds, known)
    elif fitting[0] == "a schedule":
        for key in value.keys() - {"schedule"}:
            _check(f"{name}.{key}", value[key], 0.0, {}, known)
        try:
            make_schedule(value)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None
    elif fitting[0] == "a list" and default:
        for index, item in enumerate(value):
            _check(f"{name}[{index}]", item, default[0], kinds, known)


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
