"""The documentation is true: its code runs, its links lead somewhere, what it names exists."""

from __future__ import annotations

import csv
import re
import shlex
from functools import lru_cache
from itertools import product
from pathlib import Path
from statistics import median
from textwrap import dedent

import pytest
import yaml
from omegaconf import DictConfig, OmegaConf
from processes import run_script

from torchrl_ecpo.experiment.options import compose_options, expand

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [
    *sorted(page for page in DOCS.rglob("*.md") if DOCS / "_build" not in page.parents),
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md")),
    *(ROOT / name / "README.md" for name in ("benchmarks", "sota-implementations")),
]
PAGES_WITH_DEFAULTS = [
    *(page for page in PAGES if page.parent.name == "algorithms"),
    DOCS / "hyperparameters.md",
]
ECPO_CONFIG = ROOT / "sota-implementations/ecpo/config"
ECAC_CONFIG = ROOT / "sota-implementations/ecac/config"
MUJOCO_TASKS = ("hopper", "walker2d", "halfcheetah", "ant", "humanoid")
ALGORITHMIC_TASKS = ("copy", "duplicated_input", "repeat_copy", "reverse", "reversed_addition")
# Second column of a table of defaults: the configurations that it speaks of. They are those of the
# loss of that name, or else of the loss that the page is named after, or else of ECPO; of ecpo.py
# with the form and policy of the first study, but for the recipe's own.
STATED_FOR = {
    "the recipe, algorithmic tasks": (ECPO_CONFIG, ALGORITHMIC_TASKS),
    "algorithmic tasks": (ECPO_CONFIG, ALGORITHMIC_TASKS),
    "bandit": (ECPO_CONFIG, ("bandit",)),
    "gymnasium": (ECPO_CONFIG, ("gym",)),
    "MuJoCo tasks": (ECAC_CONFIG, MUJOCO_TASKS),
    "all but Humanoid-v5": (ECAC_CONFIG, MUJOCO_TASKS[:-1]),
    "Humanoid-v5": (ECAC_CONFIG, MUJOCO_TASKS[-1:]),
    **dict.fromkeys(("GRPO", "RLOO", "TPO", "Squared-PMD", "REPS"), (ECPO_CONFIG, ("copy",))),
    **dict.fromkeys(("PMD-AC", "SAC", "TD3", "DDPG"), (ECAC_CONFIG, MUJOCO_TASKS)),
    **dict.fromkeys(
        ("Discrete-ECAC", "Discrete-PMD-AC", "Discrete-SAC"), (ECAC_CONFIG, ("minatar",))
    ),
}

FENCED = re.compile(r"^( *)```(\w*)[^\n]*\n(.*?)^\1```", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"python ((?:sota-implementations|benchmarks|docs)/\S+\.py)([^\n`]*)")
LINK = re.compile(r"\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)
# | `option` | `value` | ..., in a table whose second column is headed by one of STATED_FOR
DEFAULTS_TABLE = re.compile(r"^\| option \| ([^|]+) \|.*\n\|[-| ]+\n((?:\|.*\n)+)", re.M)
DEFAULT = re.compile(r"^\| `([\w.]+)` \| `(.+?)` \|", re.MULTILINE)


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def prose(page: Path) -> str:
    """The text without code, in which brackets mean something else."""
    return re.sub(r"`[^`\n]+`", "", FENCED.sub("", page.read_text()))


def python_blocks(page: Path) -> list[str]:
    blocks = FENCED.findall(page.read_text())
    return [dedent(block) for _, language, block in blocks if language == "python"]


def sentences(page: Path) -> list[list[str]]:
    """The words of each sentence outside code, tables, headings and pictures; a formula is one."""
    text = re.sub(r"<!--.*?-->|\$\$.*?\$\$", "", FENCED.sub("", page.read_text()), flags=re.DOTALL)
    text = re.sub(r"^ *(?:[|#!%]|\[!).*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"\]\([^)]*\)", "]", re.sub(r"`[^`]+`|\$[^$]+\$", "X", text))
    paragraphs = re.split(r"\n\s*\n|\n(?= *(?:- |\d+\. ))", text.replace("Eq. ", "Eq."))
    parts = (part for text in paragraphs for part in re.split(r"(?<=[.?!])[*)_]*\s+", text))
    words = ([word for word in part.split() if re.search(r"\w", word)] for part in parts)
    return [sentence for sentence in words if sentence]


def links(page: Path) -> list[str]:
    return [link for link in LINK.findall(prose(page)) if "://" not in link]


def anchors(page: Path) -> set[str]:
    """What follows # in links to the headings of a page, as GitHub and MyST make it."""
    headings = HEADING.findall(FENCED.sub("", page.read_text()))
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def commands(page: Path) -> list[tuple[Path, str]]:
    """Each script that a page starts, with its options."""
    one_line_each = page.read_text().replace("\\\n", " ")
    return [(ROOT / script, options) for script, options in COMMAND.findall(one_line_each)]


@lru_cache
def composed(config_directory: Path, overrides: tuple[str, ...]) -> DictConfig:
    return compose_options(config_directory.parent, overrides)


def compose_command(script: Path, options: str) -> None:
    """Compose the runs that a command line starts; of seeds one, for they compose alike."""
    words = [word for word in shlex.split(options, comments=True) if not word.startswith("-")]
    for run in expand([re.sub(r"^seed=.*", "seed=1", word) for word in words]):
        config = composed(script.parent / "config", tuple(run))
        OmegaConf.to_container(config, resolve=True, throw_on_missing=True)


EXAMPLES = [
    pytest.param(page, marks=[pytest.mark.slow] if "ray_init_config" in blocks else [])
    for page in PAGES
    if (blocks := "".join(python_blocks(page)))
]


@pytest.mark.parametrize("page", EXAMPLES, ids=name)
def test_examples_run(page, tmp_path, monkeypatch, torchrl_configs):
    # As from the repository, but what they write stays out of it.
    for folder in ("docs", "sota-implementations"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    monkeypatch.chdir(tmp_path)
    blocks = python_blocks(page)
    for script, options in commands(page):
        directory = re.search(r"hydra\.run\.dir=(\S+)", options)
        if directory and any(directory[1] in block for block in blocks):  # which read this run
            process = run_script(tmp_path, script, *shlex.split(options))
            assert process.returncode == 0, process.stderr
    namespace: dict[str, object] = {"__name__": "__main__"}
    for number, block in enumerate(blocks, start=1):
        exec(compile(block, f"{name(page)}, python block {number}", "exec"), namespace)


def test_links_lead_somewhere():
    broken = []
    for page, link in ((each, link) for each in PAGES for link in links(each)):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            broken.append(f"{name(page)}: {link}")
    assert not broken


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)], ids=name)
def test_commands_compose(page):
    for script, options in commands(page):
        assert script.is_file(), f"{name(page)} starts {script}, which does not exist"
        if (script.parent / "config").is_dir():
            compose_command(script, options)


@pytest.mark.slow
def test_the_pictures_of_the_pages_can_be_drawn(tmp_path):
    for script in sorted((DOCS / "figures").glob("*.py")):
        (tmp_path / script.name).write_text(script.read_text())
        process = run_script(tmp_path, tmp_path / script.name)
        assert process.returncode == 0, process.stderr
    (tmp_path / "llm_search.svg").touch()  # test_llm_script.py draws it
    drawn, shown = ({file.name for file in f.glob("*.svg")} for f in (tmp_path, DOCS / "figures"))
    assert drawn == shown


@pytest.mark.parametrize("page", PAGES_WITH_DEFAULTS, ids=name)
def test_stated_defaults_are_those_of_the_configuration(page):
    tables = DEFAULTS_TABLE.findall(page.read_text())
    assert tables, "there is no table of defaults"
    for heading, rows in tables:
        directory, tasks = STATED_FOR[heading]
        losses = {path.stem for path in (directory / "loss").glob("*.yaml")}
        named = (heading.lower().replace("-", "_"), page.stem, "ecpo")
        loss = next(name for name in named if name in losses)
        is_paper = directory is ECPO_CONFIG and "recipe" not in heading
        form = ("form=paper",) if is_paper else ()
        form += ("policy=lstm",) if is_paper and "copy" in tasks else ()
        for (option, stated), task in product(DEFAULT.findall(rows), tasks):
            config = composed(directory, (f"env={task}", f"loss={loss}", *form))
            value = OmegaConf.select(config, option, throw_on_resolution_failure=True)
            value = OmegaConf.to_container(value) if OmegaConf.is_config(value) else value
            assert value == yaml.safe_load(stated), f"{option} with env={task}"


def test_the_settings_that_the_search_chose_are_those_of_the_configuration():
    text = (DOCS / "hyperparameters.md").read_text()
    optimisers = dict(re.findall(r"\*\*(\w+)\*\*: .*`(optim\.amsgrad=\S+ optim\.eps=\S+)`", text))
    assert set(optimisers) == {"batch", "group"}
    losses, cell = ("ecpo", "pmd", "pmd_entropy", "urex", "ment"), r" \| `(\S+)`"
    for task in ALGORITHMIC_TASKS:
        title = task.title().replace("_", "")
        stated = {
            option: values
            for option, *values in re.findall(
                rf"^\| {title} \| `(\S+)`{len(losses) * cell} \|$", text, re.MULTILINE
            )
        }
        assert set(stated) == {"env.curriculum", "loss.tau"}
        for place, loss in enumerate(losses):
            config = composed(ECPO_CONFIG, (f"env={task}", f"loss={loss}", "form=paper"))
            for option, values in stated.items():
                assert str(OmegaConf.select(config, option)) == values[place], (task, loss)
            asked = OmegaConf.from_dotlist(optimisers[config.env.curriculum].split())
            assert config.optim.amsgrad == asked.optim.amsgrad
            assert config.optim.eps == asked.optim.eps


def test_the_study_takes_as_long_as_is_said():
    results = ROOT / "sota-implementations/results/study"
    seconds = {
        (run["options"], run["seed"]): float(run["seconds"])
        for path in results.glob("*/runs.csv")
        for run in csv.DictReader(path.read_text().splitlines())
        if run["seconds"]
    }
    assert 85 < sum(seconds.values()) / 3600 < 95
    for page in (DOCS / "tutorials/many_runs.md", ROOT / "sota-implementations/README.md"):
        assert "some ninety hours" in " ".join(page.read_text().split())


def test_the_page_of_equations_names_tests_that_exist():
    rows = [row for row in (DOCS / "equations.md").read_text().splitlines() if "`test_" in row]
    assert rows
    for row in rows:
        files = [(DOCS / link).read_text() for link in LINK.findall(row) if "/test_" in link]
        defined = {found for file in files for found in re.findall(r"^def (test_\w+)", file, re.M)}
        assert set(re.findall(r"`(test_\w+)`", row)) <= defined, row


@pytest.mark.parametrize(
    "page",
    [
        "README.md",
        *(f"docs/{name}.md" for name in ("results", "exploration", "control", "searches")),
    ],
)
def test_sentences_are_short_and_results_are_read_in_one_go(page):
    text = sentences(ROOT / page)
    assert median(map(len, text)) <= 16
    assert [" ".join(words) for words in text if len(words) > 25] == []
    assert len((ROOT / page).read_text().splitlines()) <= 450


def test_sentences_are_counted_by_hand(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "# A heading\n\n- **One, two.** See [three four](x.md) in `a b`.\n- $5 + 5$ is Eq. 6\n"
    )
    assert [len(words) for words in sentences(page)] == [2, 5, 3]


def test_a_wrong_option_is_noticed():
    script = ROOT / "sota-implementations/ecpo/ecpo.py"
    compose_command(script, " --multirun form=paper loss=ecpo,ment seed='range(0,2)' # a comment")
    with pytest.raises(Exception, match="no_such_option"):
        compose_command(script, "env=copy loss.no_such_option=1")
