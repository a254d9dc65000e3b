"""The script of language models: tasks by hand, every loss once, resuming, a model of one's own."""

from __future__ import annotations

import csv
import re
from functools import partial
from pathlib import Path
from random import Random

import numpy as np
import pytest

pytest.importorskip("transformers")

import torch
from omegaconf import OmegaConf
from processes import run_script

from torchrl_ecpo.experiment import compose_options, read_metrics

SCRIPT = Path(__file__).parents[1] / "sota-implementations/llm/llm.py"
TINY = (
    *("supervised.steps=2", "supervised.batch_size=4", "model.hidden_size=16", "model.layers=1"),
    *("num_prompts=2", "group_size=3", "evaluation.prompts=2", "evaluation.completions=64"),
    *("evaluation.interval=1", "total_completions=12"),
)


@pytest.fixture
def modules(beside):
    """Imports what is beside the script."""
    return partial(beside, "llm")


def run_llm(directory, *options, script=SCRIPT):
    process = run_script(directory, script, *TINY, *options)
    assert process.returncode == 0, process.stderr
    return process.stdout


def test_answers_are_verified(modules):
    tasks = modules("tasks").TASKS
    for answer, is_right in {
        **{"5+8": True, "8+5": True, "6-2+9": False, "2+5+6": True},  # 9 is no digit of the prompt
        **{"5+8+6-6": False, "13": False, "+5+8": False, "5+8=13": False, "": False, "5+": False},
    }.items():
        assert tasks["countdown"].is_right("2,5,6,8=13:", answer) is is_right, answer
    assert tasks["countdown"].is_right("1,3,4,7=7:", "7")
    assert tasks["sums"].is_right("5+9-3=", "11")
    assert tasks["sums"].is_right("1-9=", "-8")
    assert not tasks["sums"].is_right("5+9-3=", "12")
    random = Random(0)
    for task in tasks.values():
        for prompt, answer in (task.draw(random) for _ in range(200)):
            assert task.is_right(prompt, answer)
            assert len(answer) < task.max_tokens  # the end is a token


def test_an_answer_with_an_unknown_token_is_wrong(modules):
    """What is after the end is no part of it."""
    utils = modules("utils")
    model, tokenizer = utils.make_model(
        OmegaConf.create({"path": None, "hidden_size": 16, "layers": 1})
    )
    policy = utils.Policy(model, tokenizer, modules("tasks").TASKS["countdown"])
    tokens = policy.tokenizer("5+8<end>").input_ids
    unknown = policy.tokenizer.unk_token_id
    rows = [[*tokens, 9, 0], [tokens[0], unknown, *tokens[1:]], [0, *tokens]]
    assert policy.decode(rows) == ["5+8", "5<unk>+8", "5+8"]
    assert policy.decode(torch.tensor([[*tokens, 0]])) == ["5+8"]
    options = ["env=countdown", "loss=pmd", "loss.tau_prime=0.05"]
    assert compose_options(SCRIPT.parent, options).loss.tau_prime == 0.05


def test_pass_at_k_by_hand(modules):
    """Of four answers one is right: a draw of two has it with probability 1 - 3/4 * 2/3."""
    pass_at = modules("utils").pass_at
    assert pass_at(1, 4, 1) == 0.25
    assert pass_at(2, 4, 1) == 0.5
    assert pass_at(4, 4, 1) == 1.0
    assert pass_at(2, 4, 0) == 0.0


def test_the_entropy_is_that_of_the_completions(modules):
    """Of a model whose tokens are all as likely, a completion has length * log(vocabulary) nats."""
    utils = modules("utils")
    config = OmegaConf.create({"path": None, "hidden_size": 8, "layers": 1})
    model, tokenizer = utils.make_model(config)
    torch.nn.init.zeros_(model.lm_head.weight)
    policy = utils.Policy(model, tokenizer, modules("tasks").TASKS["countdown"])
    torch.manual_seed(0)
    batch = policy.sample_groups(["1,2,3,4=5:", "6,7,8,9=13:"], 5)  # of other lengths
    measured = policy.measure(batch)
    expected = measured["length"] * torch.tensor(len(tokenizer)).log()
    torch.testing.assert_close(measured["entropy"], expected)
    assert batch["query"].tolist() == [0] * 5 + [1] * 5
    assert batch["advantage"].shape == (10, 1, 1)


def test_every_loss_trains(tmp_path, run_here):
    """ECPO as a user starts it, the others in this process."""
    start = set()
    for loss in ("ecpo", "pmd", "tpo", "grpo"):
        directory, options = tmp_path / loss, ("env=sums", f"loss={loss}")
        directory.mkdir()
        if loss == "ecpo":
            run_llm(directory, *options, f"hydra.run.dir={directory}")
            assert (directory / "curve.png").exists()
        else:
            run_here(directory, "llm", *TINY, *options)
        metrics = read_metrics(directory)
        assert metrics["step"] == [0, 6, 12]
        names = ("pass_at_1", "pass_at_8", "pass_at_64", "distinct_right")
        start.add(tuple(metrics[name][0] for name in names))
        assert 0 < metrics["length"][1] <= 4
        assert metrics["grad_norm"][1] >= 0
        listed = (directory / "completions.txt").read_text()
        assert re.search(r"^ +\d+ (right|wrong)  ", listed, re.MULTILINE)
    assert len(start) == 1  # one model, before the first update


@pytest.mark.slow  # three times the import of transformers
def test_trl_trains_the_model_of_another_run(tmp_path):
    """From where a run of no completions ended: the same answers at the start."""
    pytest.importorskip("trl")
    start, trained = tmp_path / "start", tmp_path / "trained"
    start.mkdir(), trained.mkdir()
    run_llm(start, "env=sums", "total_completions=0", f"hydra.run.dir={start}")
    options = ("env=sums", "loss=trl", f"model.path={start}/model", "supervised.steps=0")
    script = SCRIPT.with_name("by_trl.py")
    run_llm(trained, *options, f"hydra.run.dir={trained}", script=script)
    first, metrics = read_metrics(start), read_metrics(trained)
    assert metrics["step"] == [0, 5, 11, 12]
    for name in ("pass_at_1", "pass_at_64", "distinct_right"):
        assert metrics[name][0] == first[name][0]
        assert metrics[name][3] >= 0
    assert 0 < metrics["length"][1] <= 4
    assert metrics["entropy"][1] > 0


@pytest.mark.slow  # three times the import of transformers
def test_a_run_goes_on_with_the_same_numbers(tmp_path):
    whole, part = tmp_path / "whole", tmp_path / "part"
    whole.mkdir(), part.mkdir()
    run_llm(whole, f"hydra.run.dir={whole}")
    run_llm(part, f"hydra.run.dir={part}", "total_completions=6")
    assert "Resumed" in run_llm(part, f"resume={part}")
    assert (part / "metrics.csv").read_text() == (whole / "metrics.csv").read_text()
    assert (part / "completions.txt").read_text() == (whole / "completions.txt").read_text()


def save_model(utils, directory, **special):
    config = OmegaConf.create({"path": None, "hidden_size": 16, "layers": 1})
    model, tokenizer = utils.make_model(config)
    for name, token in special.items():
        setattr(tokenizer, name, token)
    model.save_pretrained(directory)
    tokenizer.save_pretrained(directory)
    return model


def test_a_model_of_ones_own(modules, monkeypatch, tmp_path):
    utils = modules("utils")
    saved = save_model(utils, tmp_path / "model")
    monkeypatch.chdir(tmp_path)
    config = compose_options(SCRIPT.parent, ["model.path=model"])
    utils.check_run(config, utils.LOSSES)
    model, tokenizer = utils.make_model(config.model)
    torch.testing.assert_close(dict(model.named_parameters()), dict(saved.named_parameters()))
    assert model.generation_config.top_k == 0
    assert tokenizer.decode(tokenizer("2,5=7:5+2").input_ids) == "2,5=7:5+2"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("env=chess", "env must be countdown or sums, got 'chess'."),
        ("task=sums", r"task is called env\."),
        ("loss=trl", "loss= is here ecpo or pmd or tpo or grpo, got trl"),
        ("group_size=1", "group_size must be an integer >= 2, got 1."),
        ("evaluation.completions=8", "evaluation.completions must be an integer >= 64, got 8."),
        ("model.hidden_size=10", "model.hidden_size must be a multiple of 8, .* got 10."),
        ("model.hidden_size=12", "model.hidden_size must be a multiple of 8, .* got 12."),
        ("model.path=nowhere", r"model.path=nowhere: it must be a directory with a model in \*."),
        (
            "model.path=no_tokenizer",
            "with a model in .* and its tokenizer, as model.save_pretrained",
        ),
        ("model.path=no_padding", "needs an end and a padding token of its own, got pad_token="),
    ],
)
def test_what_is_wrong_is_named(modules, monkeypatch, tmp_path, options, message):
    monkeypatch.chdir(tmp_path)
    if "no_" in options:
        directory = tmp_path / options.removeprefix("model.path=")
        save_model(modules("utils"), directory, pad_token="<end>")
        if "no_tokenizer" in options:
            (directory / "tokenizer_config.json").unlink()
    utils = modules("utils")
    with pytest.raises(ValueError, match=message):
        utils.check_run(compose_options(SCRIPT.parent, [options]), utils.LOSSES)


def test_runs_of_the_comparison_are_those_of_its_cells_still(study):
    """Their options had other names; one cell of each study."""
    manifest = study.manifest.read_manifests([SCRIPT.with_name("comparison.yaml")])
    for name, own in manifest.studies.items():
        results = study.results.Results.read(study.results.RESULTS / "study" / name)
        cell = manifest.cells(own)[0]
        assert all(results.has(cell, seed) for seed in cell.seeds), name
        assert len(study.results.read_cell(cell, results).runs) == len(cell.seeds)


def test_the_page_says_what_was_measured():
    root = Path(__file__).parents[1]
    page = (root / "docs/completions.md").read_text()
    table = (root / "sota-implementations/results/llm/countdown.csv").read_text()
    rows = csv.DictReader(table.splitlines())
    names = ("pass_at_1", "pass_at_8", "pass_at_64", "distinct_right")
    runs: dict[tuple[str, str], list[list[float]]] = {}
    for row in rows:
        where = {"0": ("start", row["lr"]), "7680": (row["loss"], row["lr"])}
        if row["completions"] == "7680" or (row["completions"], row["loss"]) == ("0", "ecpo"):
            measured = [float(row[name]) for name in names]
            runs.setdefault(where[row["completions"]], []).append(measured)
    means = {
        key: [f"{sum(values) / len(values):.2f}" for values in zip(*seeds, strict=True)]
        for key, seeds in runs.items()
    }
    assert f"| at the start | | 5 | {' | '.join(means.pop(('start', '0.0003')))} |" in page
    del means["start", "0.001"]  # the same run's
    for (loss, lr), cells in means.items():
        number = len(runs[loss, lr])
        assert f"| {loss.upper()} | {lr} | {number} | {' | '.join(cells)} |" in page


def test_the_page_says_what_the_search_found(modules, tmp_path):
    comparison = modules("comparison")
    page = (Path(__file__).parents[1] / "docs/completions.md").read_text()
    comparison.draw(tmp_path / "llm_search.svg")
    assert "(figures/llm_search.svg)" in page
    rows = comparison.table("llm_search")
    assert len(rows) == 16
    assert all(row in page for row in rows)
    runs = comparison.read_runs("llm_search")
    start = comparison.at_the_start(next(iter(runs.values()))[0])
    assert f"| at the start | | {comparison.cells([start])} |" in page
    ends = {"pass_at_1": {}, "pass_at_64": {}}  # by method and rate, each setting's two seeds
    for (_, method, setting), seeds in runs.items():
        for name, by_rate in ends.items():
            values = [comparison.at_the_end(run)[name] for run in seeds]
            by_rate.setdefault((method, setting.split("optim.lr ")[1]), []).append(values)
    for method in ("ECPO", "PMD", "GRPO"):  # at the lower rate nobody trades
        lower = {name: np.mean(by_rate[method, "0.00025"], 1) for name, by_rate in ends.items()}
        assert lower["pass_at_1"].min() >= 1.4 * start["pass_at_1"]
        assert lower["pass_at_64"].min() > start["pass_at_64"]
    for method, (first, second) in {"GRPO": (0.745, 0.952), "ECPO": (0.898, 0.981)}.items():
        values = ends["pass_at_64"][method, "0.0005"][0]  # no bonus; tau = 0.5
        assert np.round(values, 3).tolist() == [first, second]
    assert np.max([ends["pass_at_1"]["TPO", rate] for rate in ("0.00025", "0.0005")]) < 0.101
    studies = ("llm_comparison", "llm_longer", "llm_by_trl")
    rows = [row for study in studies for row in comparison.table(study)]
    assert len(rows) == 11
    assert all(row in page for row in rows)
    ends = {
        method: [comparison.at_the_end(run) for run in seeds]
        for (task, method, _), seeds in comparison.read_runs("llm_comparison").items()
        if task == "countdown"
    }
    means = {
        name: [f"{np.mean([end[name] for end in ends[method]]):.3f}" for method in ("GRPO", "ECPO")]
        for name in ("pass_at_1", "pass_at_64")
    }
    assert {pass_at_64[:4] for pass_at_64 in means["pass_at_64"]} == {"0.96"}
    root = Path(__file__).parents[1]
    for name in ("README.md", "docs/tutorials/language_models.md"):
        shown = " ".join((root / name).read_text().split())
        assert "level by pass@64" in shown
        assert "0.96" in shown
        assert "{} against {}".format(*means["pass_at_1"]) in shown, name
    pairs = list(zip(ends["ECPO"], ends["GRPO"], strict=True))
    for name, above, level in (("pass_at_1", 0, 1), ("pass_at_64", 3, 0), ("distinct_right", 2, 0)):
        assert sum(ours[name] > theirs[name] for ours, theirs in pairs) == above
        assert sum(ours[name] == theirs[name] for ours, theirs in pairs) == level
