"""The study: its manifests, the queue that makes the runs, and what becomes of their results.

The queue starts a script that counts, with the files and the checkpoint of a real run; a slow test
has it start the real one.
"""

from __future__ import annotations

import csv
import dataclasses
import doctest
import json
import os
import re
import signal
import time
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from omegaconf import OmegaConf
from rliable.metrics import probability_of_improvement

from torchrl_ecpo.experiment import options
from torchrl_ecpo.experiment.figures import METHOD_COLOURS, colours_of

ROOT = Path(__file__).parents[1]
# Searches beyond the edge of a grid, where some methods had their best at two edges.
UNEQUAL = ("search_bandit_slower", "search_bandit_rivals_wider", "search_wider_reverse")
STUDY, COMMITTED = ROOT / "sota-implementations/study", ROOT / "docs"
MODULES = sorted(path.stem for path in STUDY.glob("*.py"))

COUNTER = r"""
import json, os, pathlib, sys, time, yaml

config = yaml.safe_load((pathlib.Path(__file__).parent / "config/config.yaml").read_text())
options = dict(option.split("=", 1) for option in sys.argv[1:])
config |= {name: yaml.safe_load(options[name]) for name in config.keys() & options}
seed, total, resume = config["seed"], config["total_frames"], config["resume"]
pathlib.Path("config.yaml").write_text(json.dumps(config))
pathlib.Path("versions.json").write_text('{"python": "3", "torch": "2"}')
pathlib.Path("starts").open("a").write(f"{resume}\n")
if config["broken"]:
    raise RuntimeError("the disk of the test is full")
checkpoint = pathlib.Path("checkpoint")
begin = int(checkpoint.read_text()) if checkpoint.exists() and resume == "auto" else 0
metrics = pathlib.Path("metrics.csv")
if not begin:
    metrics.write_text("step,return\n")
for step in range(begin + 1, total + 1):
    time.sleep(float(os.environ.get("COUNTER_SLEEP", 0)))
    with metrics.open("a") as file:
        file.write(f"{step},{step * config['speed'] + seed}\n")
    checkpoint.write_text(str(step))
summary = {"finished": True, "frames": total, "seconds": 60.0 * seed}
pathlib.Path("summary.json").write_text(json.dumps(summary))
"""


@pytest.fixture(scope="module")
def study(study):
    """With a bootstrap that takes little time."""
    study.scores.REPETITIONS = 200
    return study


@pytest.fixture
def counter(tmp_path):
    """A script that counts, beside its configuration."""
    folder = tmp_path / "counter"
    (folder / "config").mkdir(parents=True)
    config = {"name": "???", "seed": 0, "total_frames": 3, "speed": 1.0, "broken": False}
    (folder / "config/config.yaml").write_text(yaml.safe_dump({**config, "resume": None}))
    (folder / "counter.py").write_text(COUNTER)
    return folder / "counter.py"


def add_option(counter, line):
    with (counter.parent / "config/config.yaml").open("a") as file:
        file.write(f"{line}\n")


def plan(tmp_path, counter, *, tasks=None, **studies):
    """Write a manifest; return its path."""
    task = {"script": str(counter), "options": "name=one", "steps": 4, "metric": "return"}
    study = {"title": "A study", "tasks": ["one"], "methods": {"A": "speed=1.0"}, "seeds": "1-2"}
    content = {
        "tasks": {"one": task, **{name: {**task, **t} for name, t in (tasks or {}).items()}},
        "studies": {name: {**study, **entries} for name, entries in studies.items()},
    }
    path = tmp_path / "manifest.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def starts(runs):
    """How often, and with which resume=, each run was started."""
    files = sorted(runs.rglob("starts"))
    return {str(file.parent.relative_to(runs)): file.read_text().split() for file in files}


@pytest.mark.parametrize("name", MODULES)
def test_examples(study, name):
    result = doctest.testmod(getattr(study, name))
    assert result.failed == 0
    assert (result.attempted > 0) is (name not in ("records", "collect"))


# --------------------------------------------------------------------------------------- manifest


def test_the_study_is_what_was_planned(study):
    manifest = study.manifest.read_manifests()
    runs = {
        name: sum(len(cell.seeds) for cell in manifest.cells(entry))
        for name, entry in manifest.studies.items()
    }
    assert runs["first_bandit"] == 3 * 25
    assert runs["first_tasks"] == 5 * 3 * 25
    assert runs["figure2"] == 5 * 4 * 3
    assert runs["figure3_left"] == 2 * 5 * 10
    names = ("first_bandit", "first_tasks", "figure2")
    reported = {seed for name in names for seed in manifest.studies[name].seeds}
    searches = {n: entry for n, entry in manifest.studies.items() if n.startswith("search")}
    assert len(searches) == 19
    for name, search in searches.items():
        assert not reported & set(search.seeds), "searched on the reported seeds"
        cells = [(cell.task.name, cell.method) for cell in manifest.cells(search)]
        is_equal = len({cells.count(cell) for cell in cells}) == 1
        assert is_equal or name in UNEQUAL, name
    methods: dict[tuple[str, str], int] = {}
    for cell in (cell for search in searches.values() for cell in manifest.cells(search)):
        if cell.task.script.startswith("ecpo"):
            methods[cell.task.name, cell.method] = methods.get((cell.task.name, cell.method), 0) + 1
    for (task, method), number in methods.items():
        assert number >= methods[task, "ECPO"], f"{method} has fewer settings than ECPO on {task}"


def test_an_option_that_is_gone_or_new_makes_no_other_run_unless_it_has_another_value(study):
    changed = study.manifest.changed_entries
    assert changed({"env.head": "masked", "tau": 1}, {"tau": 1}) == []
    assert changed({"env.head": "joint"}, {}) == ["env.head was joint, is masked"]
    assert changed({"tau": 1}, {"loss.score": "return", "tau": 1}) == []
    assert changed({}, {"loss.score": "batch"}) == ["loss.score was return, is batch"]
    new = {"epochs": 1, "max_kl": "None", "policy.name": "lstm", "loss.entropy": "nats"}
    assert changed({"env.hidden_size": 128, "env.distinct_histories": True}, new) == []
    new = {"epochs": 10, "policy.name": "memoryless"}
    changes = ["epochs was 1, is 10", "policy.name was lstm, is memoryless"]
    assert sorted(changed({}, new)) == changes
    assert changed({"stop_when.at_least": 25}, {"stop_when": "None"}) == []


def test_a_run_whose_options_had_other_names_is_the_same_run(study):
    changed = study.manifest.changed_entries
    old = {"evaluation_interval": 50, "env.evaluation_interval": 7, "env.hidden_sizes": "[64]"}
    old |= {"loss.options.tau": 0.3, "loss.lr.actor_network": 0.1, "loss.lr.log_tau": 0.01}
    new = {"evaluation.interval": 50, "hidden_sizes": "[64]", "loss.tau": 0.3}
    new |= {"optim.lr.actor_network": 0.1, "optim.lr.log_tau": 0.01, "optim.lr.value_network": 3e-4}
    assert changed(old, new) == []
    assert changed(old, new | {"loss.tau": 0.5}) == ["loss.tau was 0.3, is 0.5"]
    present = study.manifest.present
    label = "loss.lr.actor_network 1e-3, loss.options.tau_prime 0.1"
    assert present(label) == "optim.lr.actor_network 1e-3, loss.tau_prime 0.1"
    assert present("my.loss.lr.x loss.lrs=1") == "my.loss.lr.x loss.lrs=1"


@pytest.mark.slow  # composing takes long
def test_committed_runs_are_those_of_their_cells_still(study):
    """A cell of each method, whose configuration is compared with that of its runs."""
    manifest, compared = study.manifest.read_manifests(), set()
    for name, own in manifest.studies.items():
        results = study.results.Results.read(study.results.RESULTS / "study" / name)
        for cell in manifest.cells(own):
            runs = study.results.read_cell(cell, results).runs
            if runs and (name, cell.method) not in compared:
                compared.add((name, cell.method))
                assert results.has(cell, next(iter(runs))), cell.name
    assert len(compared) >= 99


def test_what_determines_no_number_of_a_run_is_not_its_identity(study):
    goal = {"metric": "return", "at_least": 25, "batches": 20}
    config = {"total_trajectories": 9, "epochs": 2, "seed": 1, "threads": 1}
    for stop_when in (None, goal):
        whole = OmegaConf.create({**config, "stop_when": stop_when})
        assert study.manifest.identity(whole) == {"epochs": 2, "seed": 1}
    config = {"total_frames": 9, "seed": 1, "method": {"name": "ppo"}}
    assert "total_frames" not in study.manifest.identity(OmegaConf.create(config))
    for falling in ({"linear": ["clip_range"]}, {"method": {"name": "dqn"}}):
        own = study.manifest.identity(OmegaConf.create({**config, **falling}))
        assert own["total_frames"] == 9, "until the end something falls, whose slope it determines"


@pytest.mark.slow
def test_every_task_and_every_setting_of_the_study_composes(study):
    """Each setting on one task, as composing takes long."""
    one = {}
    for cell in study.manifest.read_manifests().select():
        one.setdefault((cell.study, cell.method, cell.setting), cell)
        one.setdefault(cell.task.name, cell)
    for cell in set(one.values()):
        assert cell.identity(1)["seed"] == 1, cell.name


def test_a_grid_is_a_product(study, tmp_path, counter):
    grid = {"speed": [1, 2], "size": {"small": "a=1 b=2", "large": "a=3"}}
    methods = {"A": {"options": "x=0", "grid": grid}}
    path = plan(tmp_path, counter, s={"methods": methods, "kind": "ranking"})
    cells = study.manifest.read_manifests([path]).select()
    assert [cell.label for cell in cells] == [
        *("speed 1, size small", "speed 1, size large"),
        *("speed 2, size small", "speed 2, size large"),
    ]
    assert cells[2].options == ("name=one", "x=0", "speed=2", "a=1", "b=2")


def test_a_choice_of_studies_tasks_methods_and_seeds(study, tmp_path, counter):
    methods = {"A": "speed=1.0", "B": "speed=2.0"}
    tasks = {"two": {"options": "name=two"}}
    both = {"methods": methods, "tasks": ["one", "two"]}
    path = plan(tmp_path, counter, tasks=tasks, s=both, t=both)
    manifest = study.manifest.read_manifests([path])
    chosen = manifest.select(only=["t"], tasks=["two"], methods=["B"], seeds=[2, 7])
    assert [(c.study, c.task.name, c.method, c.seeds) for c in chosen] == [("t", "two", "B", (2,))]
    for wrong in ({"only": ["u"]}, {"tasks": ["three"]}, {"methods": ["C"]}):
        with pytest.raises(ValueError, match=r"unknown \['\w+'\]; there are \["):
            manifest.select(**wrong)
    with pytest.raises(ValueError, match="No run is left"):
        manifest.select(seeds=[7])
    path = plan(tmp_path, counter, tasks=tasks, s=both, t={**both, "seeds": "1-3"})
    chosen = study.manifest.read_manifests([path]).select(seeds=[3])
    assert [(c.study, c.seeds) for c in chosen] == [("t", (3,))] * 4


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"seed": "1-3"}, r"study s: unknown \['seed'\]; there are .*'seeds'"),
        ({"seeds": "1-x"}, "study s: Seeds are written like 1-3,7"),
        ({"seeds": [1, 1]}, "study s: Seeds must be there, and none twice"),
        ({"tasks": ["three"]}, r"study s: tasks: unknown \['three'\]; there are \['one'\]"),
        ({"kind": "map"}, "study s: kind must be one of .*'heat_map'.*, got 'map'"),
        ({"rank_by": "best"}, "study s: rank_by must be one of .*'final'.*, got 'best'"),
        ({"kind": "heat_map"}, "study s: a heat map needs a grid of two axes"),
        ({"methods": {"A": ["x=1"]}}, "method A must be options of the script, or a mapping"),
        ({"methods": {"A": None}}, "method A must be options of the script, or a mapping"),
        ({"methods": ["A"]}, "study s: methods must be a mapping"),
        ({"methods": {"A": {"options": "", "script": "no.py"}}}, "study s: there is no script no"),
        ({"scale_by": "Z"}, r"study s: scale_by: unknown \['Z'\]"),
        ({"steps": 0}, "study s: steps must be an integer of at least 1, got 0"),
        ({"also": "entropy"}, "study s: also must be a list, got 'entropy'"),
        ({"seeds": "1-3,9-7"}, "study s: Seeds are counted upwards, got '9-7'"),
        (
            {"methods": {"A": {"options": "", "grid": {"speed": [1]}}}},
            "a grid, which needs kind",
        ),
        # Or another text in the manifest.
        (("    seeds: 1-2\n", ""), r"study s: \['seeds'\] must be given"),
        (("counter.py", "no.py"), "task one: there is no script .*no.py"),
        (("studies:", "study:"), "with .*'studies'.* and nothing else"),
    ],
)
def test_a_bad_study_is_refused(study, tmp_path, counter, entries, message):
    path = plan(tmp_path, counter, s={} if isinstance(entries, tuple) else entries)
    if isinstance(entries, tuple):
        assert entries[0] in path.read_text()
        path.write_text(path.read_text().replace(*entries))
    with pytest.raises(ValueError, match=message):
        study.manifest.read_manifests([path])


def test_an_option_that_the_script_does_not_have_is_refused(study, tmp_path, counter, capsys):
    path = plan(tmp_path, counter, s={"methods": {"A": "sped=1"}})
    with pytest.raises(SystemExit):
        study.run.main(["--manifest", str(path), "--runs", str(tmp_path / "runs")])
    assert "counter.py name=one sped=1 cannot be run" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


# ------------------------------------------------------------------------------------------ queue


@pytest.fixture
def run(study, tmp_path, capfd):
    """Start the queue in this process; return exit status and what it printed."""
    study.run.POLL = 0.01
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def start(path, *options):
        arguments = ["--manifest", str(path), "--runs", str(tmp_path / "runs"), "--workers", "2"]
        status = study.run.main([*arguments, *options])
        return status, capfd.readouterr().out

    yield start
    for number, handler in handlers.items():
        signal.signal(number, handler)


def test_what_is_done_is_skipped_and_more_seeds_are_taken_on(run, tmp_path, counter):
    path = plan(tmp_path, counter, s={})
    status, output = run(path)
    assert status == 0
    assert "2 of 2 runs are done, 0 failed" in output
    path = plan(tmp_path, counter, s={"seeds": "1-3"})
    status, output = run(path)
    assert status == 0
    assert output.count("is done") == 2
    assert output.count("begins ") == 1
    assert all(len(resumes) == 1 for resumes in starts(tmp_path / "runs").values())
    assert "done  one/A/seed 3" in run(path, "--dry-run")[1]


def test_seeds_are_stacked_and_what_has_begun_goes_on_as_it_was(study, run, tmp_path, counter):
    add_option(counter, "seeds: null\nenv: {kind: bandit}")
    cells = study.manifest.read_manifests([plan(tmp_path, counter, s={"seeds": "1-5"})]).select()
    base = cells[0].directory(tmp_path)

    def processes():
        runs = study.run.planned_runs(cells, tmp_path, stack=2)
        return {each.seeds: each.directory.name for each in runs}

    assert processes() == {(1, 2): "seeds_1_2", (3, 4): "seeds_3_4", (5,): "seed_5"}
    (base / "seeds_2_4_7").mkdir(parents=True)
    (base / "seed_5").mkdir()
    assert processes() == {(2, 4, 7): "seeds_2_4_7", (1, 3): "seeds_1_3", (5,): "seed_5"}
    stack, *_ = study.run.planned_runs(cells, tmp_path, stack=2)
    assert stack.command[2:6] == ["name=one", "speed=1.0", "seeds=[1,3]", "total_frames=4"]


@pytest.mark.parametrize(
    "given", ["env=frozenlake", "loss=trust_pcl", "collector=multi_sync", "compile=true", ""]
)
def test_runs_that_cannot_be_stacked_are_made_one_by_one(study, beside, tmp_path, given):
    ecpo = STUDY.parent / "ecpo"
    task = {"script": str(ecpo / "ecpo.py"), "options": given or "env=bandit"}
    bare = {"methods": {"A": ""}}
    path = plan(tmp_path, "", tasks={"one": task}, s=bare)
    cells = study.manifest.read_manifests([path]).select()
    runs = study.run.planned_runs(cells, tmp_path, stack=2)
    assert [each.seeds for each in runs] == ([(1,), (2,)] if given else [(1, 2)])
    beside("ecpo", "stacked")
    stacked = beside("ecpo", "stacked.options")
    assert stacked.KINDS == study.run.STACKED_KINDS
    lines = [*cells[0].options, "seeds=[1,2]"]
    with pytest.raises(ValueError, match=r"[Ss]tack") if given else nullcontext():
        stacked.check_runs(options.compose_options(ecpo, lines), lines)


@pytest.mark.slow  # real runs, of which the queue starts each in a new interpreter
def test_a_stack_is_made_continued_and_collected(study, run, tmp_path):
    options = "env.num_actions=30 group_size=5 optim.lr=0.1"
    cell = {"tasks": ["small"], "methods": {"ECPO": options}, "seeds": "1-3"}
    task = {"script": "ecpo/ecpo.py", "options": "env=bandit", "metric": "expected_reward"}
    path = tmp_path / "manifest.yaml"

    def make(steps, *more):
        content = {"tasks": {"small": task | {"steps": steps}}, "studies": {"s": {"title": "s"}}}
        content["studies"]["s"] |= cell
        path.write_text(yaml.safe_dump(content))
        return run(path, "--stack", "2", *more)

    status, output = make(50)
    assert status == 0, output
    assert "3 runs in 2 processes" in output
    assert "small/ECPO/seed 1, 2 in " in output
    assert "3 of 3 runs are done, 0 failed" in output
    assert make(50)[1].count("is done") == 2
    assert make(100)[0] == 0
    results = collect(study, tmp_path, path)
    assert [key[-1] for key in results.runs] == [1, 2, 3]
    assert all(row["reached"] == "100" for row in results.runs.values())
    (stack,) = (tmp_path / "runs").rglob("seeds_1_2")
    summary = json.loads((stack / "seed_2/summary.json").read_text())
    assert summary["stack_size"] == 2
    row = results.runs["small", "ECPO", "", 2]
    assert float(row["seconds"]) == pytest.approx(summary["seconds"] / 2, abs=0.06)


@pytest.mark.parametrize("has_buffer", [False, True])
def test_with_more_steps_a_run_goes_on_unless_it_has_left_out_a_buffer(
    run, tmp_path, counter, has_buffer
):
    if has_buffer:
        add_option(counter, "replay_buffer: 1")
    assert run(plan(tmp_path, counter, s={"seeds": "1"}))[0] == 0
    longer = plan(tmp_path, counter, s={"seeds": "1", "steps": 8})
    assert run(longer)[0] == 0
    resumed = "None" if has_buffer else "auto"
    assert list(starts(tmp_path / "runs").values()) == [["auto", resumed]]
    # A shorter one is part of it.
    assert "is done" in run(plan(tmp_path, counter, s={"seeds": "1"}))[1]


def test_a_failure_or_a_torn_file_is_reported_and_stops_nothing(run, tmp_path, counter):
    path = plan(tmp_path, counter, s={"methods": {"A": "broken=true", "B": "speed=2.0"}})
    status, output = run(path)
    assert status == 1
    assert "2 of 4 runs are done, 2 failed" in output
    *_, report = output.partition("2 failed")[0].rpartition("\none/A/seed 2: status 1")
    assert "RuntimeError: the disk of the test is full" in report
    for config in (tmp_path / "runs").rglob("config.yaml"):
        config.write_text("seed: [")
    status, output = run(plan(tmp_path, counter, s={"methods": {"B": "speed=2.0"}, "seeds": "1-3"}))
    assert status == 1
    assert "1 of 3 runs are done, 2 failed" in output


def test_a_directory_with_another_configuration_is_not_touched(study, run, tmp_path, counter):
    path = plan(tmp_path, counter, s={"seeds": "1"})
    assert run(path)[0] == 0
    add_option(counter, "new_option: 7")
    study.manifest._compose.cache_clear()
    options._defaults.cache_clear()
    status, output = run(path)
    assert status == 1
    assert "another configuration: new_option was absent, is 7. Remove it" in output
    status, output = run(path, "--dry-run")
    assert status == 1
    assert "failed (" in output
    assert "new_option was absent" in output
    assert "is done" in run(path, "--ignore", "new_option")[1]


def fork_queue(study, path, runs):
    """The queue in a process of its own, which its runs outlive."""
    process = os.fork()
    if process:
        return process
    os.environ["COUNTER_SLEEP"] = "0.4"
    try:
        status = study.run.main(
            ["--manifest", str(path), "--runs", str(runs), "--workers", "2"],
        )
    except BaseException:
        status = 99
    os._exit(status)


def wait_for_rows(runs, number):
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        files = list(runs.rglob("metrics.csv"))
        if len(files) == 2 and all(len(file.read_text().split()) > number for file in files):
            return
        time.sleep(0.01)
    raise AssertionError("the runs have not begun")


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_queue_that_was_ended_goes_on_and_makes_no_run_twice(
    study, run, tmp_path, counter, number
):
    """Its runs outlive one that was killed; one that was stopped stops them."""
    path, runs = plan(tmp_path, counter, s={"seeds": "1-3", "steps": 8}), tmp_path / "runs"
    is_killed = number == signal.SIGKILL
    process = fork_queue(study, path, runs)
    wait_for_rows(runs, 2)
    os.kill(process, number)
    _, status = os.waitpid(process, 0)
    if not is_killed:
        assert os.waitstatus_to_exitcode(status) == 128 + number
        assert len(starts(runs)) == 2, "a run was begun after the signal"
        rows = [file.read_text() for file in sorted(runs.rglob("metrics.csv"))]
        time.sleep(0.5)
        assert [file.read_text() for file in sorted(runs.rglob("metrics.csv"))] == rows
    status, output = run(path)
    assert status == 0, output
    assert output.count("another process runs it") == (2 if is_killed else 0)
    assert "3 of 3 runs are done, 0 failed" in output
    begun = ["auto"] if is_killed else ["auto", "auto"]
    assert sorted(starts(runs).values()) == [["auto"], begun, begun]
    for file in runs.rglob("metrics.csv"):
        with file.open() as lines:
            assert [int(row["step"]) for row in csv.DictReader(lines)] == list(range(1, 9))


# ---------------------------------------------------------------------------- collecting, reporting


def make_runs(run, path):
    status, output = run(path)
    assert status == 0, output


def collect(study, tmp_path, path, *options):
    results = ["--results", str(tmp_path / "results")]
    study.collect.main([*(options or [str(tmp_path / "runs")]), "--manifest", str(path), *results])
    return study.results.Results.read(tmp_path / "results/study/s")


def test_runs_are_told_by_their_configuration_wherever_they_are(
    study, run, tmp_path, counter, capfd
):
    path = plan(tmp_path, counter, s={"steps": 200})
    make_runs(run, path)
    (tmp_path / "runs/one").rename(tmp_path / "by_hand")
    results = collect(study, tmp_path, path, str(tmp_path / "by_hand"))
    assert sorted(results.runs) == [("one", "A", "", 1), ("one", "A", "", 2)]
    row = results.runs["one", "A", "", 2]
    assert row["reached"] == "200"
    assert row["seconds"] == "120.0"
    assert row["options"] == "name=one speed=1.0"
    assert row["torch"] == "2"
    # The mean of steps 1 and 2, plus the seed; then of 3 and 4.
    assert results.curves["one", "A", "", 2][:2] == [
        {"step": 2, "return": 3.5},
        {"step": 4, "return": 5.5},
    ]
    assert results.configs["one/A"]["speed"] == 1.0
    other = plan(tmp_path, counter, s={"methods": {"B": "speed=3.0"}, "steps": 200})
    collect(study, tmp_path, other, str(tmp_path / "by_hand"), "--unmatched")
    output = capfd.readouterr().out
    assert "nearest is one/B, but speed was 3.0, is 1.0" in output
    assert "2 of 2 runs are in no cell" in output
    results = collect(study, tmp_path, other, str(tmp_path / "by_hand"), "--ignore", "speed")
    assert len(results.runs) == 4


@pytest.mark.parametrize("has_goal", [True, False])
def test_a_run_that_stopped_early_is_whole(study, tmp_path, counter, has_goal):
    """It holds until the end what it held when it stopped; without a goal it is a part of a run.

    It is none of a cell with another goal.
    """
    add_option(counter, "stop_when: null")
    goal = "stop_when={metric:return,at_least:3.0,batches:1}"
    methods = {"A": "speed=1.0", "B": f"speed=1.0 {goal}"}
    path = plan(tmp_path, counter, s={"steps": 200, "seeds": "1", "methods": methods})
    cell, stopping = study.manifest.read_manifests([path]).select()
    directory = tmp_path / "runs/by_hand"
    directory.mkdir(parents=True)
    config = {**cell.config, "seed": 1, "total_frames": 200}
    config["stop_when"] = {"metric": "return", "at_least": 3.0, "batches": 1} if has_goal else None
    OmegaConf.save(config, directory / "config.yaml")
    rows = [(step, min(step, 4), 7 if step < 99 else "nan") for step in range(1, 101)]
    lines = ["step,return,entropy", *(",".join(map(str, row)) for row in rows)]
    (directory / "metrics.csv").write_text("\n".join(lines) + "\n")
    (directory / "summary.json").write_text('{"finished": true, "frames": 100}')
    record = study.records.Record(directory)
    assert (record.finished, record.stopped_at, record.reached) == (
        (True, 100, 200) if has_goal else (False, None, 100)
    )
    assert study.collect.is_of(stopping, record, [])
    assert study.collect.is_of(cell, record, []) is not has_goal
    assert study.collect.is_of(cell, record, ["stop_when"])
    assert ("but stop_when was" in study.collect.nearest(record, [cell])) is has_goal
    with pytest.raises(ValueError, match=r"stop_when was .*3\.0") if has_goal else nullcontext():
        assert not study.run.Run(cell, (1,), directory).is_done
    results = study.results.Results(tmp_path / "results/study/s")
    assert results.add(cell, record, ["return", "entropy"])
    results.write()
    results = study.results.Results.read(results.directory)
    assert results.has(cell, 1) is has_goal
    row, curve = results.runs["one", "A", "", 1], results.curves["one", "A", "", 1]
    assert row["reached"] == ("200" if has_goal else "100")
    assert row["stopped_at"] == ("100" if has_goal else "")
    assert [point["step"] for point in curve] == [*range(2, 201 if has_goal else 101, 2)]
    assert curve[:2] == [
        {"step": 2, "return": 1.5, "entropy": 7},
        {"step": 4, "return": 3.5, "entropy": 7},
    ]
    for point in curve[50:]:
        assert point == {"step": point["step"], "return": 4, "entropy": 7}
    assert not results.add(cell, record, ["return", "entropy"]), "it is there"


def test_results_stay_unless_a_run_went_further_or_the_cell_has_changed(
    study, run, tmp_path, counter, capfd
):
    path = plan(tmp_path, counter, s={})
    make_runs(run, path)
    first = collect(study, tmp_path, path)
    files = {file: file.read_text() for file in first.directory.iterdir()}
    empty = tmp_path / "empty"
    empty.mkdir()
    assert collect(study, tmp_path, path, str(empty)) == first
    assert {file: file.read_text() for file in first.directory.iterdir()} == files
    make_runs(run, plan(tmp_path, counter, s={"steps": 6, "seeds": "1"}))
    longer = collect(study, tmp_path, path)
    assert longer.runs["one", "A", "", 1]["reached"] == "6"
    assert longer.runs["one", "A", "", 2] == first.runs["one", "A", "", 2]
    changed = plan(tmp_path, counter, s={"methods": {"A": "speed=2.0"}, "seeds": "1"})
    make_runs(run, changed)
    results = collect(study, tmp_path, changed)
    assert list(results.runs) == [("one", "A", "", 1)]
    assert "results of one/A are dropped, for speed was 1.0, is 2.0" in capfd.readouterr().out


def test_curves_of_the_same_run_follow_the_length_of_their_cell(study, run, tmp_path, counter):
    shorter, longer = ({"steps": steps, "seeds": "1"} for steps in (100, 200))
    make_runs(run, plan(tmp_path, counter, s=longer))
    for entries, last in ((shorter, 100), (longer, 200), (shorter, 100)):
        results = collect(study, tmp_path, plan(tmp_path, counter, s=entries))
        curve = results.curves["one", "A", "", 1]
        assert (len(curve), curve[-1]["step"]) == (100, last)
        assert collect(study, tmp_path, plan(tmp_path, counter, s=entries)) == results


def test_a_longer_run_is_none_of_a_cell_where_settings_fall_until_the_end(
    study, run, tmp_path, counter, capfd
):
    add_option(counter, "linear: [speed]")
    shorter, longer = ({"steps": steps, "seeds": "1"} for steps in (3, 4))
    make_runs(run, plan(tmp_path, counter, s=longer))
    assert collect(study, tmp_path, plan(tmp_path, counter, s=shorter)).runs == {}
    assert len(collect(study, tmp_path, plan(tmp_path, counter, s=longer)).runs) == 1
    assert not study.results.Results.read(tmp_path / "results/study/s").has(
        study.manifest.read_manifests([plan(tmp_path, counter, s=shorter)]).select()[0], 1
    )
    make_runs(run, plan(tmp_path, counter, s=shorter))  # beside the longer one
    assert len(collect(study, tmp_path, plan(tmp_path, counter, s=shorter)).runs) == 1


def test_a_metric_that_the_study_also_shows_since_is_taken_in(study, run, tmp_path, counter):
    path = plan(tmp_path, counter, s={"seeds": "1"})
    make_runs(run, path)
    bare = collect(study, tmp_path, path).curves["one", "A", "", 1]
    (record,) = (tmp_path / "runs").rglob("metrics.csv")
    head, *rows = record.read_text().split()
    record.write_text("\n".join([f"{head},length", *(f"{row},7" for row in rows)]) + "\n")
    assert collect(study, tmp_path, path).curves["one", "A", "", 1] == bare
    path = plan(tmp_path, counter, s={"seeds": "1", "also": ["length"]})
    more = [{**point, "length": 7} for point in bare]
    assert collect(study, tmp_path, path).curves["one", "A", "", 1] == more
    # One without it is no better.
    record.write_text("\n".join([head, *rows]) + "\n")
    assert collect(study, tmp_path, path).curves["one", "A", "", 1] == more


def test_a_strange_directory_keeps_no_other_run_out(study, run, tmp_path, counter, capfd):
    path = plan(tmp_path, counter, s={"steps": 200, "seeds": "1-3"})
    make_runs(run, path)
    runs = tmp_path / "runs"
    first, second = sorted(runs.rglob("config.yaml"))[:2]
    first.write_text("seed: [")
    (second.parent / "metrics.csv").write_text("\n")
    for name, config in (("empty", ""), ("other", "seed: 3\n")):
        (runs / name).mkdir()
        (runs / name / "config.yaml").write_text(config)
        (runs / name / "metrics.csv").write_text("step\n1\n")
    (runs / "stopped").mkdir()
    arguments = [str(runs), "--manifest", str(path), "--results", str(tmp_path / "results")]
    assert study.collect.main(arguments) == 1
    output = capfd.readouterr().out
    assert output.count("is left out") == 3
    assert "no configuration of one of the scripts" in output
    results = study.results.Results.read(tmp_path / "results/study/s")
    assert [key[-1] for key in results.curves] == [3]


def test_studies_are_made_seed_by_seed_and_what_two_ask_for_once(study, tmp_path, counter):
    methods = {"A": "speed=1.0", "B": "speed=2.0"}
    longer = {"seeds": "1,11", "steps": 6}
    path = plan(tmp_path, counter, s={"methods": methods}, t={"seeds": "11-12"}, u=longer)
    cells = study.manifest.read_manifests([path]).select()
    runs = study.run.planned_runs(cells, tmp_path / "runs")
    assert [(str(run).removeprefix("one/"), run.command[-3]) for run in runs] == [
        ("A/seed 1", "total_frames=6"),
        ("B/seed 1", "total_frames=4"),
        ("A/seed 2", "total_frames=4"),
        ("B/seed 2", "total_frames=4"),
        ("A/seed 11", "total_frames=6"),
        ("A/seed 12", "total_frames=4"),
    ]


def test_what_has_results_is_not_missing(study, run, tmp_path, counter, capfd):
    path = plan(tmp_path, counter, s={})
    make_runs(run, path)
    collect(study, tmp_path, path)
    capfd.readouterr()

    def missing(*options, **entries):
        path = plan(tmp_path, counter, s={"seeds": "1-3", **entries})
        arguments = ("--missing", "--results", str(tmp_path / "results"), "--dry-run")
        status, output = run(path, "--runs", str(tmp_path / "elsewhere"), *arguments, *options)
        assert status == 0
        return [line.split()[3:-1] for line in output.splitlines()]

    every = [["1"], ["2"], ["3"]]
    assert missing() == [["3"]]
    assert missing(seeds="1-2") == []
    assert missing(steps=5) == every
    assert missing(methods={"A": "speed=2.0"}) == every
    assert missing("--ignore", "speed", methods={"A": "speed=2.0"}) == [["3"]]


def synthetic(study, tmp_path, counter, curves, steps=100, **entries):
    """A manifest and committed results: by task and method, what the return is at each seed."""
    tasks = {task: {"steps": steps, "solved": 5, "best": 10.0} for task, _ in curves}
    methods = {
        method: f"speed={i + 1}" for i, method in enumerate(dict.fromkeys(m for _, m in curves))
    }
    path = plan(
        tmp_path, counter, tasks=tasks, s={"tasks": list(tasks), "methods": methods, **entries}
    )
    manifest = study.manifest.read_manifests([path])
    results = study.results.Results(tmp_path / "results/study/s")
    for cell in manifest.cells(manifest.studies["s"]):
        for seed, slope in curves[cell.task.name, cell.method].items():
            at = np.arange(1, steps + 1)
            record = SimpleNamespace(
                identity={"speed": cell.method},
                seed=seed,
                reached=steps,
                metrics={"step": at, "return": slope * at / steps},
                unit="frames",
                finished=True,
                stopped_at=None,
                seconds=90,
                versions={"torch": "2"},
            )
            results.add(cell, record, ["return"])
    results.write()
    return manifest


def report(study, manifest, tmp_path):
    return study.report.write_report(manifest, tmp_path / "results", tmp_path).read_text()


def test_the_report_says_what_runs_say_and_what_is_missing(study, tmp_path, counter):
    curves = {
        ("copy", "A"): {1: 10.0, 2: 9.0, 3: 8.0},
        ("copy", "B"): {1: 4.0, 2: 3.0},
        ("reverse", "A"): {1: 10.0, 2: 6.0, 3: 7.0},
        ("reverse", "B"): {1: 2.0, 2: 8.0},
    }
    manifest = synthetic(study, tmp_path, counter, curves, seeds="1-3")
    state = np.random.get_state()[1].copy()
    text = report(study, manifest, tmp_path)
    assert (np.random.get_state()[1] == state).all()
    assert "| copy | A | `name=one speed=1` | 100 | 3 | 1-3 | 1.5 |" in text
    assert "| copy | B | `name=one speed=2` | 100 | **2 of 3 planned** | 1-2 | 1.5 |" in text
    # B: 2 of 3 runs; the mean of 91 to 100 hundredths of 4 and 3; never 5, of 100 steps.
    assert "| copy | B | 2 of 3 | 1.768 ± 0.252 | 3.3 ± 0.5 | 0% | > 100 |" in text
    # On Reverse all of A's three runs are better than one of B's two, and one is better than both.
    assert re.search(r"\| reverse \| B \| 0\.67 \(.*\) \| 0\.67 \(.*\) \|", text)
    # Slopes of 10, 9 and 8 are at 5 after 50, 56 and 63 steps.
    assert "| 100% | 56 |" in text
    assert "probability that A is better" in text
    # Final scores are 0.955 of the slopes. Without the best and the worst of A's six and of B's
    # four, they are 9.55, 8.595, 7.64 and 6.685; 3.82 and 2.865; of 10, the best.
    assert "| A | 3 | 0.81 (" in text
    assert "| B | 2 | 0.33 (" in text


def test_a_panel_is_drawn_of_several_runs_with_solved_and_best_possible(study, tmp_path, counter):
    curves = {
        ("copy", "A"): {1: 10.0, 2: 9.0},
        ("copy", "B"): {1: 4.0},  # half of the methods have several runs
        ("reverse", "A"): {1: 10.0},
        ("reverse", "B"): {1: 2.0},
    }
    text = report(study, synthetic(study, tmp_path, counter, curves, seeds="1-3"), tmp_path)
    assert "| reverse | B | 1 of 3 |" in text
    picture = (tmp_path / "figures/study/s.svg").read_text()
    texts = re.findall(r"<text [^>]*>([^<]+)</text>", picture)
    assert {"copy", "A", "B", "solved", "best possible", "frames", "return"} <= set(texts)
    assert "reverse" not in texts
    assert " of " not in "".join(texts)


def test_methods_that_are_drawn_together_have_colours_of_their_own(study):
    for entry in study.manifest.read_manifests().studies.values():
        if entry.kind == "curves":
            colours = colours_of(entry.methods)
            assert set(colours.values()) <= set(METHOD_COLOURS.values())
            assert len(set(colours.values())) == len(colours), entry.name
            for method, colour in colours.items():
                assert colours_of([method]) == {method: colour}, "it has no colour in the table"


def test_runs_with_other_options_than_the_manifest_now_has_do_not_count(study, tmp_path, counter):
    manifest = synthetic(study, tmp_path, counter, {("copy", "A"): {1: 1.0, 2: 2.0}})
    entry = manifest.studies["s"]
    results = study.results.Results.read(tmp_path / "results/study/s")
    (cell,) = manifest.cells(entry)
    assert len(study.results.read_cell(cell, results).runs) == 2
    other = dataclasses.replace(cell, options=("name=one", "speed=9"))
    assert study.results.read_cell(other, results).runs == {}
    longer = dataclasses.replace(cell, steps=200)
    assert study.results.read_cell(longer, results).unfinished == 2


def test_what_was_never_measured_and_scales_below_zero_spoil_no_report(study, tmp_path, counter):
    curves = {("copy", "A"): {1: -1.0, 2: -2.0}, ("copy", "B"): {1: -3.0, 2: -4.0}}
    scaled = synthetic(study, tmp_path, counter, curves, scale_by="A")
    text = report(study, scaled, tmp_path)
    assert "| copy | B | 2 |" in text
    assert "Final scores" not in text
    (tmp_path / "results/study/s/curves.csv").write_text("")
    assert "| copy | A | `name=one speed=1` | 100 | 2 |" in report(study, scaled, tmp_path)


def assert_pictures_are_committed(folder):
    """Byte for byte."""
    for file in sorted(folder.iterdir()):
        committed = COMMITTED / "figures/study" / file.name
        assert file.read_bytes() == committed.read_bytes(), file.name


def test_the_report_writes_the_committed_sections(study, monkeypatch, tmp_path):
    """Of the studies that are reported within a second; the slow test has all."""
    monkeypatch.setattr(study.scores, "REPETITIONS", 2000)
    manifest, page = study.manifest.read_manifests(), (COMMITTED / "study.md").read_text()
    assert page.startswith(study.report.INTRODUCTION)
    quick = ("dm_control", "sensitivity_temperatures")
    waiting = page.partition("## Without a complete run yet")[2]
    for name, entry in manifest.studies.items():
        if name in quick or (entry.kind == "ranking" and f"(`{name}`)" not in waiting):
            section = study.report.section(
                entry, study.results.read_cells(manifest, entry), tmp_path
            )
            assert f"\n\n{section}\n" in page, name
    assert len(list((tmp_path / "figures/study").iterdir())) == 2
    assert_pictures_are_committed(tmp_path / "figures/study")


@pytest.mark.slow
def test_make_report_writes_the_committed_page_byte_for_byte(study, monkeypatch, tmp_path):
    monkeypatch.setattr(study.scores, "REPETITIONS", 2000)
    assert study.report.main(["--docs", str(tmp_path)]) == 0
    assert (tmp_path / "study.md").read_bytes() == (COMMITTED / "study.md").read_bytes()
    folders = (tmp_path / "figures/study", COMMITTED / "figures/study")
    written, committed = ({file.name for file in folder.iterdir()} for folder in folders)
    assert written == committed, "a figure of a study that is no more, or is not committed"
    assert_pictures_are_committed(tmp_path / "figures/study")


STATED = re.compile(r"(-?[\d,.]+) ± ([\d,.]+)(?: \((.+)\))?")


@pytest.mark.parametrize(
    ("page", "names", "heading"),
    [
        ("docs/results.md", ("first_bandit", "first_tasks"), r"task \| trajectories"),
        ("docs/control.md", ("figure2",), r"task[^|]*(?:\| runs )?\| ECAC"),
    ],
)
def test_the_tables_of_results_state_what_is_committed(study, page, names, heading):
    tables = re.findall(rf"^\| {heading}.*\n(?:\|.*\n)+", (ROOT / page).read_text(), re.M)
    (lines,) = ([line[2:-2].split(" | ") for line in table.splitlines()] for table in tables)
    header, _, *rows = lines
    committed = [result for name in names for result in study.claims.committed(name).values()]
    results = {(result.title, result.cell.method): result for result in committed}
    assert len(rows) == len({title for title, _ in results})
    assert {method for _, method in results} <= set(header)
    for row in rows:
        title = {"bandit": "10,000-armed bandit"}.get(row[0], row[0])
        of_task = {method: result for (task, method), result in results.items() if task == title}
        for column, stated in zip(header[1:], row[1:], strict=True):
            if column in of_task:
                assert_stated(study, of_task[column], stated)
                continue
            for result in of_task.values():
                task, steps = result.cell.task, f"{result.cell.steps:,}"
                count = str(len(result.runs))
                best = f"{task.best or 0:.3g}"
                assert stated == {"trajectories": steps, "runs": count}.get(column, best), column


def assert_stated(study, result, stated):
    """Mean and standard error to the digits that are stated, and what is in brackets."""
    mean, error, brackets = STATED.fullmatch(stated).groups()
    finals, threshold = result.finals, result.cell.task.solved
    for text, value in ((mean, finals.mean()), (error, finals.std(ddof=1) / len(finals) ** 0.5)):
        assert text == f"{value:,.{len(text.partition('.')[2])}f}"
    if threshold is not None:
        assert brackets == study.report.scores("", result.scored, threshold)[-2]
    elif brackets is not None:
        assert brackets == ", ".join(f"{value:,.0f}" for value in finals)


@pytest.mark.parametrize("page", ["README.md", "docs/results.md"])
def test_who_solves_what_is_as_the_report_has_it(page):
    of_study = (COMMITTED / "study.md").read_text()
    (table,) = re.findall(
        r"^\| task \| ECPO \| UREX \| MENT \| Dr.*\n(?:\|.*\n)+", (ROOT / page).read_text(), re.M
    )
    for line in table.splitlines():
        assert line in of_study


# ------------------------------------------------------------------------------------------ scores


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([[5.0], [5.0], [5.0]], ["100%", "1"]),
        ([[5.0], [1.0], [5.0]], ["67%", "1"]),
        ([[5.0], [1.0]], ["50%", "> 1"]),
        ([[5.0], [5.0], [1.0], [5.0]], ["75%", "1"]),
        ([[1.0], [1.0]], ["0%", "> 1"]),
    ],
)
def test_share_and_median_of_runs_that_solve_a_task(study, values, expected):
    curve = (np.array([1.0]), np.array(values))
    assert study.report.scores("", curve, 5.0)[-2:] == expected
    assert study.report.scores("", curve, None)[-2:] == ["", ""]


def test_interquartile_mean_and_probability_of_improvement_by_hand(study):
    # The middle half of 1, 2, 3, 4, 5, 6, 7, 100 is 3, 4, 5, 6.
    scores = {"A": np.array([[1, 2], [3, 4], [5, 6], [7, 100.0]])}
    estimate = study.scores.interquartile_means(scores)["A"]
    assert estimate.value == 4.5
    assert 1 < estimate.low < 4.5 < estimate.high
    # Of the four pairs, 3 beats 1 and 2; 1 and 2 tie with, or lose to, 2.
    pairs = {"A": np.array([[3.0], [2.0]]), "B": np.array([[1.0], [2.0]])}
    better = study.scores.probabilities_of_improvement(pairs, "A")
    assert better["B"].value == (2 + 1 + 0.5) / 4
    drawn = np.random.default_rng(0).integers(0, 5, (2, 6, 3)).astype(float)
    better = study.scores.probabilities_of_improvement(dict(zip("AB", drawn, strict=True)), "A")
    assert better["B"].value == pytest.approx(probability_of_improvement(*drawn))
