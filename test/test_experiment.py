from __future__ import annotations

import fcntl
import json
import math
import re
import shutil

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from omegaconf import OmegaConf

from torchrl_ecpo.experiment import MetricsTable, Run, leaving_nothing, read_metrics
from torchrl_ecpo.experiment import run as run_module
from torchrl_ecpo.experiment.compare import Comparison, final, find_runs, load_comparison
from torchrl_ecpo.experiment.compare import main as compare
from torchrl_ecpo.experiment.figures import (
    draw_curve,
    plot_comparison,
    plot_learning_curve,
    save_figure,
)

PNG = b"\x89PNG\r\n"


def make_config(backend="csv", **entries):
    logger = {"backend": backend, "project": "test", "wandb_mode": "offline"}
    return OmegaConf.create({"seed": 3, "logger": logger, "loss": {"name": "ecpo"}, **entries})


def make_run(directory, config=None):
    directory.mkdir(parents=True, exist_ok=True)
    return Run(
        config or make_config(),
        total=30,
        unit="trajectories",
        name="bandit/ecpo/seed_3",
        shown=("return", "evaluation"),
        directory=directory,
    )


def record(run):
    run.log({"return": 1.0}, step=10)
    run.log({"return": 2.0, "evaluation": 5.0}, step=20)
    run.log({"return": 4.0}, step=30)


def test_a_run_leaves_config_versions_metrics_summary_and_picture(tmp_path, capsys):
    with make_run(tmp_path) as run:
        record(run)
    assert OmegaConf.load(tmp_path / "config.yaml").seed == 3
    versions = json.loads((tmp_path / "versions.json").read_text())
    assert {"python", "torch", "torchrl", "torchrl-ecpo"} <= versions.keys()
    metrics = read_metrics(tmp_path)
    assert metrics["step"] == [10, 20, 30]
    assert metrics["return"] == [1, 2, 4]
    assert metrics["evaluation"][1] == 5
    assert math.isnan(metrics["evaluation"][0])
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["finished"] is True
    assert summary["trajectories"] == 30
    assert (summary["return"], summary["evaluation"]) == (4, 5)
    assert (tmp_path / "curve.png").read_bytes().startswith(PNG)
    assert str(tmp_path / "curve.png") in capsys.readouterr().out


def test_one_process_makes_a_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run_module, "PATIENCE", 0)
    main = leaving_nothing(lambda config: make_run(tmp_path, config).begin())
    with (tmp_path / ".lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # as the other process
        with pytest.raises(SystemExit, match=f"{tmp_path} is in use: another process makes this"):
            main(make_config())
        assert [path.name for path in tmp_path.iterdir()] == [".lock"]
    main(make_config())
    assert (tmp_path / "config.yaml").exists()


@pytest.mark.parametrize(
    ("error", "backend"),
    [
        (RuntimeError, "csv"),
        (ValueError, "tensorboard"),
        pytest.param(ValueError, "wandb", marks=pytest.mark.slow),
    ],
)
def test_a_run_that_fails_before_its_first_row_leaves_nothing(
    tmp_path, monkeypatch, error, backend
):
    """Nor what a buffer on the disk has made; from its first row on it keeps all."""
    monkeypatch.setenv("WANDB_SILENT", "true")
    (tmp_path / "mine").write_text("")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run_module, "to_absolute_path", lambda path: tmp_path.parent / path)

    @leaving_nothing
    def main(config):
        with make_run(tmp_path, config) as run:
            run.begin()
            (tmp_path / "replay_buffer").mkdir()
            (tmp_path / "replay_buffer/0.memmap").write_text("")
            if config.seed:
                run.log({"return": 1.0}, step=10)
            raise error("of the simulator")

    for seed, left in ((0, {"mine"}), (1, {"mine", "config.yaml", "metrics.csv", "replay_buffer"})):
        with pytest.raises(error, match="of the simulator"):
            main(make_config(backend, seed=seed))
        assert left <= {path.name for path in tmp_path.iterdir()}
        assert seed or left == {path.name for path in tmp_path.iterdir()}


def test_a_run_that_begins_removes_what_is_there_of_another(tmp_path):
    with make_run(tmp_path) as run:
        record(run)
    other = make_run(tmp_path, make_config(mine=1))
    assert {"summary.json", "curve.png"} < {path.name for path in tmp_path.iterdir()}
    assert "mine" not in OmegaConf.load(tmp_path / "config.yaml")
    other.begin()
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"config.yaml", "versions.json", "command.txt"}
    assert OmegaConf.load(tmp_path / "config.yaml").mine == 1
    other.log({"return": 1.0}, step=40)
    assert read_metrics(tmp_path)["step"] == [40]


def test_an_interrupted_run_keeps_its_record_and_says_so(tmp_path):
    run = make_run(tmp_path)
    record(run)
    run.__exit__(KeyboardInterrupt, KeyboardInterrupt(), None)
    assert json.loads((tmp_path / "summary.json").read_text())["finished"] is False
    assert len(read_metrics(tmp_path)["step"]) == 3
    assert (tmp_path / "curve.png").exists()


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_loss_that_is_not_finite_stops_the_run_and_is_recorded(tmp_path, value):
    run = make_run(tmp_path)
    run.log({"loss_actor": 1.0}, step=10)
    with pytest.raises(FloatingPointError, match=f"loss_actor is {value} at trajectories 20"):
        run.log({"loss_actor": value}, step=20)
    run.__exit__(None, None, None)
    assert len(read_metrics(tmp_path)["step"]) == 2


@pytest.mark.parametrize("backend", ["tensorboard", pytest.param("wandb", marks=pytest.mark.slow)])
def test_other_loggers_come_beside_the_record(tmp_path, backend, monkeypatch):
    monkeypatch.setenv("WANDB_SILENT", "true")
    with make_run(tmp_path, make_config(backend)) as run:
        record(run)
    written = [path.name for path in tmp_path.rglob("*")]
    pattern = {"tensorboard": "events.out.tfevents", "wandb": "offline-run"}[backend]
    assert any(pattern in name for name in written), written
    assert read_metrics(tmp_path)["return"] == [1, 2, 4]


@pytest.mark.slow
def test_runs_of_one_process_have_wandb_runs_of_their_own(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_SILENT", "true")
    folders = [tmp_path / "one", tmp_path / "other"]
    for folder in folders:
        folder.mkdir()
    one, other = (make_run(folder, make_config("wandb")) for folder in folders)
    with one, other:
        record(one)
        record(other)
    assert [len(list(folder.rglob("*.wandb"))) for folder in folders] == [1, 1]
    with make_run(folders[0], make_config("wandb")) as resumed:
        resumed.load_state_dict(one.state_dict())
        resumed.log({"return": 1.0}, step=40)
    parts = [path.stem for path in folders[0].rglob("*.wandb")]
    assert len(parts) == 2
    assert len({*parts}) == 1, "a run that goes on is the same one for W&B"


def test_a_folder_without_a_record_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no metrics\.csv in .*directory of a run"):
        read_metrics(tmp_path)


def test_an_unknown_logger_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"logger\.backend must be one of .*'csv'.*got 'excel'"):
        make_run(tmp_path, make_config("excel"))


def test_table_in_memory_and_on_disk_agree(tmp_path):
    table = MetricsTable(tmp_path / "metrics.csv")
    table.log_metrics({"a": 1.5}, step=1)
    table.log_metrics({"b": 2.5}, step=2)
    assert table.rows == [{"step": 1, "a": 1.5}, {"step": 2, "b": 2.5}]
    assert (tmp_path / "metrics.csv").read_text().split() == ["step,a,b", "1,1.5,", "2,,2.5"]


@pytest.mark.parametrize("damage", ["", "step,a\n1,9.5\n", None])
def test_a_record_that_another_program_spoils_is_written_anew(tmp_path, capsys, damage):
    table, path = MetricsTable(tmp_path / "metrics.csv"), tmp_path / "metrics.csv"
    table.log_metrics({"a": 1.5}, step=1)
    table.log_metrics({"a": 2.5}, step=2)
    assert not capsys.readouterr().err
    path.unlink() if damage is None else path.write_text(damage)
    table.log_metrics({"a": 3.5}, step=3)
    assert f"{path} was changed or removed by another program" in capsys.readouterr().err
    table.log_metrics({"a": 4.5}, step=4)
    assert path.read_text().split() == ["step,a", "1,1.5", "2,2.5", "3,3.5", "4,4.5"]
    assert not capsys.readouterr().err


def test_a_record_that_is_removed_after_the_last_row_is_there_in_the_end(tmp_path):
    with make_run(tmp_path) as run:
        record(run)
        (tmp_path / "metrics.csv").unlink()
    assert read_metrics(tmp_path)["step"] == [10, 20, 30]


def test_a_record_whose_directory_is_removed_ends_the_run(tmp_path):
    table = MetricsTable(tmp_path / "run/metrics.csv")
    table.path.parent.mkdir()
    table.log_metrics({"a": 1.5}, step=1)
    shutil.rmtree(table.path.parent)
    with pytest.raises(FileNotFoundError, match="metrics"):
        table.log_metrics({"a": 2.5}, step=2)


@pytest.mark.parametrize("number", [int, float])
def test_steps_grow_also_after_resuming(tmp_path, number):
    run = make_run(tmp_path)
    for step in (10, 20):
        run.log({"return": 0.1 * step}, number(step))
    state, path = run.state_dict(), tmp_path / "metrics.csv"
    written = path.read_text()
    run.log({"return": 1.0, "evaluation": 2.0}, number(30))
    resumed = make_run(tmp_path)
    resumed.load_state_dict(state)
    assert path.read_text() == written
    assert resumed.state_dict()["record"] == state["record"]
    for each in (run, resumed):
        with pytest.raises(ValueError, match=r"step must grow, got 20(\.0)? after"):
            each.log({"return": 1.0}, number(20))
    with pytest.raises(ValueError, match="metric cannot be called step"):
        resumed.log({"step": 1.0}, number(25))
    resumed.log({"return": 1.0}, number(25))
    assert path.read_text().split()[-1] == f"{number(25)},1.0"


def test_a_state_is_loaded_before_the_first_row(tmp_path):
    state = make_run(tmp_path).state_dict()
    resumed = make_run(tmp_path)
    resumed.load_state_dict(state)
    record(resumed)
    assert read_metrics(tmp_path)["step"] == [10, 20, 30]


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """Without the pictures that runs leave."""
    monkeypatch.setattr("torchrl_ecpo.experiment.run.plot_learning_curve", lambda *_, **__: "")
    curves = {"ecpo": [(1.0, 3.0, 5.0), (1.0, 5.0, 7.0)], "urex": [(0.0, 1.0, 2.0)]}
    for method, values in curves.items():
        for seed, returns in enumerate(values):
            loss = {"name": method, "tau": 0.1 * (seed + 1)}
            config = make_config(loss=loss, total_trajectories=30, seed=seed)
            with make_run(tmp_path / method / str(seed), config) as run:
                for i, value in enumerate(returns):
                    run.log({"return": value}, step=10 * (i + 1))
    return tmp_path


def test_a_picture_has_the_levels_of_its_own_panels(tmp_path):
    curves = {"ecpo": (np.arange(3.0), np.ones((2, 3)))}
    levels = {"Copy": {"solved": 25.0}, "Reverse": {"perfect": 31.0}}
    path = plot_comparison(
        {"Copy": curves}, tmp_path / "a.svg", x_label="", y_label="", levels=levels
    )
    assert "solved" in path.read_text()
    assert "perfect" not in path.read_text()


def test_comparison_puts_the_runs_of_a_method_together(runs):
    comparison = load_comparison(find_runs([runs]), "return")
    steps, values = comparison.curves["ecpo"]
    assert steps.tolist() == [10, 20, 30]
    assert values.tolist() == [[1, 3, 5], [1, 5, 7]]
    # 1, 3, 5 and 1, 5, 7: means of 3 and 4.5 over the run, by trapezoids.
    assert "| ecpo | 2 | 30 | 3.750 ± 0.750 | 6.000 ± 1.000 | 5.000 |" in comparison.table()
    assert "| urex | 1 | 30 | 1.000 | 2.000 | 2.000 |" in comparison.table()


def test_a_run_that_has_solved_its_task_keeps_its_last_value(tmp_path):
    """It would be averaged over its climb alone; one that was killed has nothing to keep."""
    config = make_config(
        loss={"name": "ecpo"}, total_trajectories=30, seed=0, stop_when={"metric": "return"}
    )
    with make_run(tmp_path / "0", config) as run:
        run.log({"return": 1.0}, step=10)
        run.log({"return": 9.0}, step=20)
    steps, values = load_comparison([tmp_path / "0"], "return").curves["ecpo"]
    assert (steps.tolist(), values.tolist()) == ([10, 20, 30], [[1, 9, 9]])
    (tmp_path / "0/summary.json").unlink()
    steps, values = load_comparison([tmp_path / "0"], "return").curves["ecpo"]
    assert (steps.tolist(), values.tolist()) == ([10, 20], [[1, 9]])


def test_comparison_ranks_methods_by_their_mean_over_the_run():
    steps, early, late = np.array([10.0, 20.0]), np.array([[4.0, 4.0]]), np.array([[0.0, 6.0]])
    rows = Comparison("return", {"late": (steps, late), "early": (steps, early)}).table()
    assert re.findall(r"\| (late|early) ", rows) == ["early", "late"]


def test_the_metric_of_a_comparison_is_by_default_the_evaluation(runs):
    assert load_comparison(find_runs([runs])).metric == "return"
    with make_run(runs / "evaluated") as run:
        run.log({"return": 1.0, "evaluation_return": 2.0}, step=10)
    assert load_comparison([runs / "evaluated"]).metric == "evaluation_return"


def test_comparison_tells_methods_apart_by_what_it_is_told(runs):
    comparison = load_comparison(find_runs([runs]), "return", by=["loss.name", "loss.tau"])
    assert set(comparison.curves) == {
        "ecpo, loss.tau 0.1",
        "ecpo, loss.tau 0.2",
        "urex, loss.tau 0.1",
    }


def test_compare_prints_a_table_and_writes_picture_and_curves(runs, capsys):
    output, table = runs / "picture.svg", runs / "curves.csv"
    compare([str(runs), "--metric", "return", "--output", str(output), "--csv", str(table)])
    printed = capsys.readouterr().out
    assert "| ecpo | 2 |" in printed
    assert str(output) in printed
    texts = re.findall(r"<text [^>]*>([^<]+)</text>", output.read_text())
    assert {"ecpo", "urex", "trajectories", "return"} <= set(texts)
    lines = table.read_text().splitlines()
    assert lines[0] == "method,run,step,return"
    assert lines[-1] == "urex,0,30,2"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["nowhere"], "error: There is no run (a folder with metrics.csv) below nowhere.\n"),
        (["--metric", "score"], "has no metric 'score'; it has ["),
        (["--by", "loss.theta"], "has no entry 'loss.theta' to tell methods apart.\n"),
        (["--csv", "{bare}/no/x.csv"], "No such file or directory: '{bare}/no/x.csv'"),
        (["--output", "x.text"], "Format 'text' is not supported"),
        (["{bare}"], "There is no config.yaml in {bare}: is it the directory of a run?"),
    ],
)
def test_compare_says_in_a_line_what_it_cannot_do(runs, capsys, options, message):
    bare = runs / "urex/0"
    options = [option.format(bare=bare) for option in options]
    if options == [str(bare)]:
        (bare / "config.yaml").unlink()
    with pytest.raises(SystemExit):
        compare(options if len(options) == 1 else [str(runs), *options])
    assert message.format(bare=bare) in capsys.readouterr().err


def test_compare_takes_a_summary_that_was_cut_off_for_none(runs, capsys):
    (runs / "urex/0/summary.json").write_text('{"finished": tr')
    compare([str(runs)])
    printed = capsys.readouterr().out
    assert printed.count("not finished") == 1
    assert str(runs / "urex/0") in printed


def test_the_end_of_a_run_that_has_only_begun_is_its_first_row():
    values = np.array([[2.0], [4.0]])
    assert final(np.array([0]), values).tolist() == [2, 4]


def test_a_picture_that_cannot_be_written_leaves_no_part(tmp_path, monkeypatch):
    def savefig(figure, path, **options):
        path.write_bytes(PNG)
        raise OSError("No space left on device")

    monkeypatch.setattr(Figure, "savefig", savefig)
    with pytest.raises(OSError, match="No space left"):
        save_figure(Figure(), tmp_path / "picture.png")
    assert not list(tmp_path.iterdir())


def test_a_curve_of_one_point_is_seen():
    panel = Figure().subplots()
    steps, values = np.array([5.0, 10.0]), np.array([[1.0, 2.0], [2.0, 3.0]])
    draw_curve(panel, steps[:1], values[:, :1], color="k", label="one")
    draw_curve(panel, steps, values, color="k", label="two")
    assert [line.get_marker() for line in panel.lines] == ["o", "None"]


def test_the_picture_of_a_run_has_a_panel_for_what_was_measured(tmp_path):
    rows = [{"step": 10, "return": 1.0, "ESS": math.nan}, {"step": 20, "return": 2.0}]

    def plot(metrics):
        path = tmp_path / "curve.svg"
        return plot_learning_curve(rows, path, metrics=metrics, title="a run", x_label="frames")

    picture = plot(["return", "ESS", "entropy"]).read_text()
    texts = re.findall(r"<text [^>]*>([^<]+)</text>", picture)
    assert {"return", "a run", "frames"} <= set(texts)
    assert {"ESS", "entropy"}.isdisjoint(texts)
    assert picture.count("<use ") > 2, "two points are seen as points"
    assert plot(["ESS", "entropy"]) is None


def test_the_band_of_a_curve_is_the_standard_error_over_runs():
    panel, steps = Figure().subplots(), np.array([10.0, 20.0, 30.0])
    # -2, 0 and 2 around the mean: a sample variance of 8 / 2, a third of it for the mean of three.
    runs = np.array([[2.0, 1.0, 7.0], [4.0, 1.0, 5.0], [6.0, 1.0, 3.0]])
    draw_curve(panel, steps, runs, color="k", label="three")
    (band,) = panel.collections
    corners = band.get_paths()[0].vertices
    edges = [{y for x, y in corners if x == step} for step in steps]
    error = (4 / 3) ** 0.5
    assert [min(edge) for edge in edges] == pytest.approx([4 - error, 1, 5 - error])
    assert [max(edge) for edge in edges] == pytest.approx([4 + error, 1, 5 + error])


def test_methods_are_told_apart_by_what_is_null_too(runs):
    for name, target in (("fixed", None), ("learned", 0.1)):
        loss = {"name": "ecac", "target_kl": target}
        with make_run(runs / name, make_config(loss=loss)) as run:
            run.log({"return": 1.0}, step=10)
    found = find_runs([runs / "fixed", runs / "learned"])
    comparison = load_comparison(found, "return", by=["loss.name", "loss.target_kl"])
    assert set(comparison.curves) == {"ecac, loss.target_kl null", "ecac, loss.target_kl 0.1"}


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"seed": 1}, "ecpo has the seed 1 twice, in .*ecpo/1 and .*other.*--by"),
        (
            {"env": {"name": "reverse"}},
            "ecpo has runs on several tasks, .*ecpo/0 and .*other.*--by",
        ),
    ],
)
def test_a_mean_is_of_runs_that_are_alike(runs, entries, message):
    with make_run(runs / "other", make_config(**entries)) as run:
        run.log({"return": 1.0}, step=10)
    with pytest.raises(ValueError, match=message):
        load_comparison(find_runs([runs]), "return")


def test_steps_of_any_library_are_numbers_of_python(tmp_path):
    with make_run(tmp_path) as run:
        run.log({"return": 1.0}, step=np.int64(10))
        run.log({"return": 2.0}, step=torch.tensor(20))
    assert (tmp_path / "metrics.csv").read_text().split() == ["step,return", "10,1.0", "20,2.0"]
    assert json.loads((tmp_path / "summary.json").read_text())["trajectories"] == 20


def test_comparison_refuses_runs_that_cannot_be_compared(runs):
    with make_run(runs / "ecpo/2", make_config(loss={"name": "ecpo", "tau": 0.1})) as run:
        run.log({"return": 1.0}, step=1000)
    with pytest.raises(ValueError, match="ecpo have no steps in common: one ends at 30, another"):
        load_comparison(find_runs([runs]), "return")
    with make_run(runs / "late", make_config(loss={"name": "late", "tau": 0.1})) as run:
        run.log({"return": float("nan")}, step=10)
    with pytest.raises(ValueError, match=r"late has no value of 'return' yet"):
        load_comparison(find_runs([runs / "late"]), "return")
