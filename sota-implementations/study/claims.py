"""What pages claim of committed results, in phrases that are compared with what the results say.

``sota-implementations/results/claims.yaml`` has, by id, the phrases of a paragraph, each with an
expression over the functions of this module. The numbers of a phrase must be the expression's, to
the digits that are written; a phrase without a number is true if the expression is. A page quotes
a claim at the end of the paragraph: ``<!-- claim: id -->``.

A cell of a study is written ``"study/task/method"``, with ``"/setting"`` if it has a grid.
"""

from __future__ import annotations

import csv
import re
from functools import cache

import numpy as np
import scores
from manifest import read_manifests
from results import RESULTS, CellResult, read_cells

from torchrl_ecpo.experiment.compare import Curve, area, final

REPORT = RESULTS.parents[1] / "docs" / "study.md"
NUMBER = re.compile(r"(?<![\w@.])-?(?:\d{1,3}(?:,\d{3})+|\d+(?:\.\d+)?)")
QUOTE = re.compile(r"<!-- claim: (\S+) -->")
PARAGRAPH = re.compile(r"\n\n|\n(?= *- )")


# ---------------------------------------------------------------------------------- claims, pages


def now(phrase: str, expression: str) -> str:
    """The phrase with the numbers that its expression has now.

    Raises:
        ValueError: if the expression has more or fewer numbers than the phrase, or is false.

    Examples:
        >>> now("15.2 ± 0.5 (20%)", "15.52, 0.45, 0.2")
        '15.5 ± 0.5 (20%)'
        >>> now("ahead in nine of ten", "2 > 1")
        'ahead in nine of ten'
    """
    value = eval(expression, {**globals()})
    if not NUMBER.search(phrase):
        if not value:
            raise ValueError(f"{phrase!r} does not hold: {expression}")
        return phrase
    numbers = iter(_flat(value))

    def written(match: re.Match[str]) -> str:
        digits = len(match[0].partition(".")[2])
        number = next(numbers) * (100 if phrase[match.end() :].startswith(("%", " %")) else 1)
        return f"{round(number, digits) + 0.0:,.{digits}f}"

    try:
        text = NUMBER.sub(written, phrase)
    except StopIteration:
        raise ValueError(f"{phrase!r} has more numbers than {value}: {expression}") from None
    if more := list(numbers):
        raise ValueError(f"{phrase!r} lacks {more}: {expression}")
    return text


def _flat(value) -> list[float]:
    """The numbers of nested lists, in order."""
    return [n for each in value for n in _flat(each)] if np.iterable(value) else [float(value)]


def quotes(page: str) -> list[tuple[str, str]]:
    r"""The claims that a page quotes, each with the text of its paragraph, list item or table.

    Examples:
        >>> quotes("- Copy: 5 of\n  **5**. <!-- claim: copy -->\n- Reverse")
        [('copy', '- Copy: 5 of 5.')]
    """
    found = []
    for paragraph in PARAGRAPH.split(page):
        text = " ".join(QUOTE.sub("", paragraph).replace("**", "").split())
        found += [(claim, text) for claim in QUOTE.findall(paragraph)]
    return found


def is_in(phrase: str, text: str) -> bool:
    """Whether a phrase is part of a text, and not of longer words or numbers.

    Examples:
        >>> is_in("5 of 5", "25 of 5"), is_in("5", "in 5."), is_in("5", "5.2"), is_in("5", "-5")
        (False, True, False, False)
    """
    return re.search(rf"(?<![\w.,-]){re.escape(phrase)}(?!\w|[.,]\d)", text) is not None


# ------------------------------------------------------------------------- what expressions call


mean, median = np.mean, np.median
manifest = cache(read_manifests)


@cache
def committed(study: str) -> dict[str, CellResult]:
    """Results of a study, by ``task/method`` and, with a grid, ``/setting``."""
    cells = read_cells(manifest(), manifest().studies[study])
    return {result.cell.name: result for result in cells}


def cell(path: str) -> CellResult:
    """The results of a cell."""
    study, _, name = path.partition("/")
    return committed(study)[name]


def curve(path: str, metric: str = "") -> Curve:
    """Steps ``[n]`` and values ``[runs, n]`` of a metric; by default the task's own."""
    found = cell(path).curve(metric or cell(path).cell.task.metric)
    if found is None:
        raise ValueError(f"{path} has no run with {metric or 'the metric of the task'}.")
    return found


def ends(path: str, metric: str = "") -> np.ndarray:
    """The mean of each run over its last tenth, ``[runs]``."""
    return final(*curve(path, metric))


def by_end(path: str, metric: str = "") -> np.ndarray:
    """How runs end in a metric, the run with the lowest final score first, ``[runs]``."""
    return ends(path, metric)[ends(path).argsort()]


def areas(path: str) -> np.ndarray:
    """The area under the curve of each run, over its length, ``[runs]``."""
    return area(*curve(path))


def last(path: str, metric: str = "") -> np.ndarray:
    """The last measurement of each run, ``[runs]``."""
    return curve(path, metric)[1][:, -1]


def average(path: str, metric: str, first: float, until: float) -> np.ndarray:
    """The mean of each run over the steps after ``first`` and not after ``until``, ``[runs]``."""
    steps, values = curve(path, metric)
    return values[:, (first < steps) & (steps <= until)].mean(axis=1)


def at(path: str, step: float, metric: str = "") -> np.ndarray:
    """What each run has at a step, ``[runs]``."""
    steps, values = curve(path, metric)
    return values[:, steps.tolist().index(step)]


def needed(path: str, value: float | None = None) -> np.ndarray:
    """The step at which each run first has a value, by default the task's threshold, ``[runs]``.

    Infinite if it never has.
    """
    value = cell(path).cell.task.solved if value is None else value
    if value is None:
        raise ValueError(f"{path} has no threshold: name a value.")
    return scores.steps_to_solve(*curve(path), value)


def played(path: str) -> np.ndarray:
    """The steps of the environment that each run needs to solve its task, ``[runs]``.

    Infinite if it never does.
    """
    episodes, lengths = curve(path, "length")
    steps = (np.diff(episodes, prepend=0) * lengths).cumsum(-1)
    ends = needed(path)[:, None]
    return np.where(np.isfinite(ends[:, 0]), (steps * (episodes == ends)).sum(-1), np.inf)


def finite(values: np.ndarray) -> np.ndarray:
    """The finite ones."""
    return values[np.isfinite(values)]


def solved(path: str) -> tuple[int, int]:
    """How many runs solve the task at any time, and how many there are."""
    steps = needed(path)
    return len(finite(steps)), len(steps)


def when(path: str) -> float:
    """The median of the steps that runs need to solve the task, of those that do."""
    steps = finite(needed(path))
    return median(steps) if len(steps) else np.inf


def solved_by_task(study: str, name: str) -> list[list[float]]:
    """Of each task of a study: how many runs of a cell solve it, and when; 0 where none does."""
    paths = [f"{study}/{task}/{name}" for task in manifest().studies[study].tasks]
    return [[count, when(path)] if (count := solved(path)[0]) else [0] for path in paths]


def lost(path: str) -> int:
    """How many runs solve the task and end below its threshold."""
    is_below = last(path) < (cell(path).cell.task.solved or 0)
    return int((is_below & np.isfinite(needed(path))).sum())


def spread(values: np.ndarray) -> tuple[float, float]:
    """The mean of runs and its standard error."""
    return values.mean(), values.std(ddof=1) / len(values) ** 0.5


def outcome(path: str) -> tuple[float, float, float]:
    """Mean of how runs end, its standard error, and the share of runs that solve the task."""
    count, total = solved(path)
    return *spread(ends(path)), count / total


def wins(one: np.ndarray, other: np.ndarray) -> int:
    """Of all pairs of a run of the one and a run of the other: in how many the one is higher."""
    return int((one[:, None] > other).sum())


def intervals(study: str, *cells: str) -> list[float]:
    """The numbers of the row of the report that begins with these cells and has intervals."""
    title = manifest().studies[study].title
    _, _, section = REPORT.read_text().partition(f"\n## {title}\n")
    section, _, _ = section.partition("\n## ")
    start = f"| {' | '.join(cells)} | "
    rows = [line for line in section.splitlines() if line.startswith(start) and " to " in line]
    (row,) = rows
    return [float(number) for number in NUMBER.findall(row.removeprefix(start))]


def settings(study: str, method: str, *values: str) -> np.ndarray:
    """Mean measurement of the cells with these values of the grid, ``[tasks with runs]``."""
    cells = [each for each in committed(study).values() if each.cell.method == method]
    chosen = [each for each in cells if tuple(v for _, v in each.cell.setting) == values]
    return np.array([each.scored[1].mean() for each in chosen if each.scored])


def trial(path: str, method: str = "") -> dict[str, np.ndarray]:
    """Columns of a file of runs that are in no study, below ``results``; of one method in it."""
    rows = csv.DictReader((RESULTS / f"{path}.csv").read_text().splitlines())
    chosen = [row for row in rows if row.pop("method", "") == method]
    return {name: np.array([float(row[name] or "nan") for row in chosen]) for name in chosen[0]}


def trial_reached(path: str, value: float) -> float:
    """Trajectories until the mean return of ten gradient steps of such a run is at a value."""
    columns = trial(path)
    means = np.convolve(columns["return"], np.ones(10) / 10, "valid")
    return columns["step"][9:][means >= value][0]


def trial_evaluations(path: str, *steps: int) -> list[float]:
    """Return of the deterministic policy of such a run at some steps."""
    columns = trial(path)
    return [columns["evaluation_return"][columns["step"] == step][0] for step in steps]
