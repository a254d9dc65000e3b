"""A run that was stopped and resumed is the run that was never stopped, number for number."""

from __future__ import annotations

import csv
import importlib
import io
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from torchrl.checkpoint import Checkpoint, CheckpointError
from torchrl.envs import DMControlEnv, GymEnv, TransformedEnv

from torchrl_ecpo import ECPOLoss
from torchrl_ecpo.envs import EpisodeReplay
from torchrl_ecpo.experiment import Checkpoints
from torchrl_ecpo.experiment.checkpoint import run_directory

SCRIPT_MODULES = ("utils", "tasks", "stack", "score_sac", "ecpo", "ecac")
SCRIPTS = Path(__file__).parents[1] / "sota-implementations"
BANDIT = ("ecpo", "env=bandit", "env.num_actions=20", "total_trajectories=60", "group_size=5")
ALGORITHMIC = ("num_groups=2", "group_size=8", "env.hidden_size=8", "evaluation_interval=2")
CONTROL = (
    "ecac",
    "total_frames=240",
    "log_interval=40",
    "evaluation.interval=80",
    "evaluation.episodes=1",
    "collector.init_random_frames=80",
    "hidden_sizes=[16,16]",
    "replay_buffer.batch_size=16",
)
ECAC_STATES = "loss.options.num_actor_states=8"
RUNS = {
    "bandit": BANDIT,
    "copy": ("ecpo", "env=copy", "total_trajectories=192", "project_steps=2", *ALGORITHMIC),
    "cartpole": (
        *("ecpo", "env=gym", "total_trajectories=192", "env.max_steps=20"),
        *("num_groups=2", "group_size=8", "evaluation_interval=1"),
    ),
    "pendulum": (*CONTROL, "env=pendulum", ECAC_STATES),
    "hopper": (
        *(*CONTROL, "env=hopper", ECAC_STATES),
        *("loss.reference_interval=5", "replay_buffer.size=100"),
    ),
    "memmap": (*CONTROL, "env=pendulum", "loss=td3", "replay_buffer.storage=memmap"),
}


@pytest.fixture
def start(monkeypatch):
    """Runs a script in this process, in a directory: up to a boundary, or to its end."""
    monkeypatch.setattr("torchrl_ecpo.experiment.run.plot_learning_curve", lambda *_, **__: "")

    def start(directory, script, *options, stop_at=None, kill_at=None, save_at=None):
        for name in SCRIPT_MODULES:
            sys.modules.pop(name, None)
        monkeypatch.syspath_prepend(str(SCRIPTS / script))
        main = importlib.import_module(script).main
        with initialize_config_dir(str(SCRIPTS / script / "config"), version_base="1.3"):
            config = compose("config", ["checkpoint.interval=null", *options])
        boundary, count = Checkpoints.boundary, 0

        def counted(checkpoints):
            nonlocal count
            count += 1
            if count == stop_at:
                os.kill(os.getpid(), signal.SIGTERM)
            if count == save_at:
                checkpoints.save()
            if count == kill_at:
                raise Killed
            boundary(checkpoints)

        directory.mkdir(exist_ok=True)
        monkeypatch.chdir(directory)
        with monkeypatch.context() as patch:
            patch.setattr(Checkpoints, "boundary", counted)
            main.__wrapped__(config)

    yield start
    for name in SCRIPT_MODULES:
        sys.modules.pop(name, None)


class Killed(Exception):
    """Ends a run with nothing but what is on the disk."""


def record(directory):
    """The rows of a run as they are written, but for the clock."""
    with (directory / "metrics.csv").open(newline="") as file:
        return [
            {name: cell for name, cell in row.items() if name != "steps_per_second"}
            for row in csv.DictReader(file)
        ]


def checkpoints(directory):
    return sorted((directory / "checkpoints").iterdir())


def last_state(directory, part):
    """A part of the last checkpoint."""
    path = checkpoints(directory)[-1]
    return torch.load(path / Checkpoint.manifest(path)["components"][part]["path"] / "state.pt")


def assert_same_run(one, other):
    assert record(one) == record(other)
    for part in ("loss_module", "optimizer"):
        states = [last_state(directory, part) for directory in (one, other)]
        torch.testing.assert_close(*states, rtol=0, atol=0, equal_nan=True)
    randoms = [last_state(directory, "random")["torch_cpu"] for directory in (one, other)]
    assert torch.equal(*randoms)


@pytest.mark.parametrize("name", RUNS)
def test_a_resumed_run_equals_one_that_was_never_stopped(tmp_path, start, capfd, name):
    run, whole, parts = RUNS[name], tmp_path / "whole", tmp_path / "parts"
    if name == "hopper":
        pytest.importorskip("mujoco")
    first, second = (17, 23) if run[0] == "ecac" else (2, 3)
    start(whole, *run)
    # Stopped by a signal, then killed some time after a checkpoint.
    with pytest.raises(SystemExit) as stop:
        start(parts, *run, stop_at=first)
    assert stop.value.code == 128 + signal.SIGTERM
    assert f"Resume with: python {sys.argv[0]} resume={parts}" in capfd.readouterr().out
    with pytest.raises(Killed):
        start(parts, *run, f"resume={parts}", save_at=1, kill_at=second - first + 1)
    assert len(record(parts)) < len(record(whole))
    start(parts, *run, f"resume={parts}")
    assert_same_run(parts, whole)


@pytest.fixture
def interrupted(tmp_path, start):
    """The directory of a run with a checkpoint, which was killed two rows later."""
    with pytest.raises(Killed):
        start(tmp_path, *RUNS["bandit"], save_at=4, kill_at=6)
    return tmp_path


def test_a_full_disk_ends_the_run_and_leaves_the_last_checkpoint(interrupted, start, monkeypatch):
    def fill(state, path):
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    run = (*RUNS["bandit"], f"resume={interrupted}")
    with monkeypatch.context() as patch:
        patch.setattr(torch, "save", fill)
        message = r"trajectories 30 could not be written: .*No space left.* good one is .*-0*20"
        with pytest.raises(CheckpointError, match=message):
            start(interrupted, *run, save_at=2)
    assert [path.name[-2:] for path in checkpoints(interrupted)] == ["20"]
    start(interrupted, *run)
    start(interrupted / "whole", *RUNS["bandit"])
    assert_same_run(interrupted, interrupted / "whole")


def truncate(directory):
    (path,) = checkpoints(directory)
    file = next(path.glob("components/*loss_module/state.pt"))
    file.write_bytes(file.read_bytes()[:-100])


def truncate_manifest(directory):
    (path,) = checkpoints(directory)
    (path / "manifest.json").write_text('{"format": "torchrl.ch')


def make_foreign(directory):
    Checkpoint(value={"step": 1}).save(checkpoints(directory)[0])


def cut_record(directory):
    path = directory / "metrics.csv"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:3]))


@pytest.mark.parametrize(
    ("spoil", "options", "message"),
    [
        (truncate, (), "checkpoint-0*20 cannot be restored: .*'loss_module'.* remove it"),
        (truncate_manifest, (), "nothing to resume from, for .*checkpoints holds no checkpoint"),
        (make_foreign, (), "checkpoint-0*20 is no checkpoint of a run of this script"),
        (cut_record, (), "metrics.csv does not reach to step 20"),
        (None, ("loss.tau=1", "seed=7"), "loss.tau was 0.01, is 1; seed was 0, is 7. Resume with"),
        (None, ("resume=elsewhere",), "resume=elsewhere is not this run's directory"),
    ],
)
def test_what_cannot_be_resumed_is_refused(interrupted, start, spoil, options, message):
    config = (interrupted / "config.yaml").read_text()
    if spoil is not None:
        spoil(interrupted)
    with pytest.raises((CheckpointError, ValueError), match=message):
        start(interrupted, *RUNS["bandit"], f"resume={interrupted}", *options)
    if spoil is None:
        assert (interrupted / "config.yaml").read_text() == config
        assert len(record(interrupted)) == 6


@pytest.mark.parametrize("save_at", [None, 1])
def test_a_new_run_in_an_old_directory_forgets_the_old_one(interrupted, start, capfd, save_at):
    """One that is killed before its first checkpoint is begun again."""
    with pytest.raises(Killed):
        start(interrupted, *RUNS["bandit"], "seed=8", save_at=save_at, kill_at=2)
    folder = interrupted / "checkpoints"
    kept = [path.name[-2:] for path in folder.iterdir()] if folder.exists() else []
    assert kept == (["05"] if save_at else [])
    start(interrupted, *RUNS["bandit"], "seed=8", "resume=auto")
    begins = "resume=auto found no checkpoint: a new run begins" in capfd.readouterr().out
    assert begins is (save_at is None)
    start(interrupted / "whole", *RUNS["bandit"], "seed=8")
    assert_same_run(interrupted, interrupted / "whole")


@pytest.mark.parametrize(
    "name", ["plain_1", "env-a,loss-b", "it's (a) run", r"back\slash", r"end\'"]
)
def test_the_command_that_resumes_is_one_that_hydra_reads(tmp_path, name):
    config = {"resume": None, "checkpoint": {"interval": 1, "keep": 1, "max_share": 0.1}}
    command = Checkpoints(OmegaConf.create(config), tmp_path / name).command
    override = shlex.split(command)[-1]
    (parsed,) = OverridesParser.create().parse_overrides([override])
    assert parsed.value() == str(tmp_path / name)
    assert not parsed.is_sweep_override()


def test_a_finished_run_stays_as_it_is(tmp_path, start, capfd):
    run = (*RUNS["pendulum"], "total_frames=120")
    start(tmp_path, *run)
    rows, (path,) = record(tmp_path), checkpoints(tmp_path)
    assert "replay_buffer" not in Checkpoint.manifest(path)["components"]
    start(tmp_path, *run, "resume=auto")
    assert record(tmp_path) == rows
    assert "which had finished" in capfd.readouterr().out


@pytest.mark.parametrize("kind", ["loss", "gradient", "parameter"])
def test_numbers_that_are_not_finite_stop_the_run_with_a_good_checkpoint(
    tmp_path, start, monkeypatch, capfd, kind
):
    calls, forward = 0, ECPOLoss.forward

    def spoilt(loss_module, tensordict):
        nonlocal calls
        calls += 1
        if calls == 8 and kind == "loss":
            raise ValueError("log_prob must be finite")
        losses = forward(loss_module, tensordict)
        if calls == 8 and kind == "gradient":
            losses["loss_actor"] = losses["loss_actor"] * float("inf")
        if calls == 8 and kind == "parameter":
            with torch.no_grad():
                next(loss_module.parameters())[:] = float("nan")
        return losses

    monkeypatch.setattr(ECPOLoss, "forward", spoilt)
    message = {
        "loss": "log_prob must be finite",
        "gradient": "loss_actor is -?inf at trajectories 35",
        "parameter": "log-probability under the actor is NaN or infinite",
    }[kind]
    with pytest.raises((FloatingPointError, ValueError), match=message):
        start(tmp_path, *RUNS["bandit"], "project_steps=3", save_at=1)
    # The seventh step, in the middle of a projection, was the last good one.
    steps = [int(path.name.rsplit("-")[-1]) for path in checkpoints(tmp_path)]
    assert steps == ([15] if kind == "parameter" else [15, 35])
    assert all(value.isfinite().all() for value in last_state(tmp_path, "loss_module").values())
    if kind == "parameter":
        assert "No checkpoint is written at trajectories" in capfd.readouterr().err
        return
    monkeypatch.setattr(ECPOLoss, "forward", forward)
    start(tmp_path, *RUNS["bandit"], "project_steps=3", f"resume={tmp_path}")
    assert [int(row["step"]) for row in record(tmp_path)] == [*range(5, 70, 5)]


def test_writing_takes_a_bounded_share_of_the_time(tmp_path, start, monkeypatch):
    now = 0.0

    def clock():
        nonlocal now
        now += 1.0  # a second passes from each look at the clock to the next
        return now

    saved_at, save = [], Checkpoints.save

    def recorded(checkpoints, **options):
        saved_at.append(checkpoints.step)
        save(checkpoints, **options)

    monkeypatch.setattr(Checkpoints, "save", recorded)
    monkeypatch.setattr("torchrl_ecpo.experiment.checkpoint.time", SimpleNamespace(monotonic=clock))
    often = ("checkpoint.interval=0", "checkpoint.max_share=0.25")
    start(tmp_path, *RUNS["bandit"], *often)
    # Each takes a second, and four pass from one to the next; the last one ends the run.
    assert saved_at == [5, 25, 45, 60]


@pytest.mark.parametrize(
    "task",
    ["Pendulum-v1", "CartPole-v1", "Hopper-v5", "Humanoid-v5", ("reacher", "easy")],
    ids=str,
)
def test_a_simulator_goes_on_where_it_was(task):
    pytest.importorskip("mujoco")

    def make():
        env = GymEnv(task) if isinstance(task, str) else DMControlEnv(*task)
        return TransformedEnv(env, EpisodeReplay())

    env, other = make(), make()
    other.set_seed(1)
    other.load_state_dict(env.state_dict())  # before the first episode
    assert (env.reset() == other.reset()).all()
    state = env.reset()
    for _ in range(40):
        _, state = env.step_and_maybe_reset(env.rand_action(state))
    file = io.BytesIO()
    torch.save(env.state_dict(), file)
    file.seek(0)
    other.load_state_dict(torch.load(file))
    again = state.clone()
    for _ in range(60):  # through the end of an episode of those that end early
        again["action"] = env.rand_action(state)["action"].clone()
        step, state = env.step_and_maybe_reset(state)
        step_again, again = other.step_and_maybe_reset(again)
        assert (step == step_again).all()
        assert (state == again).all()


@pytest.mark.parametrize(
    ("resume", "directory"),
    [(None, "new"), ("auto", "2026-02-01"), ("2026-01-01", "2026-01-01")],
)
def test_where_a_run_goes(tmp_path, monkeypatch, resume, directory):
    monkeypatch.chdir(tmp_path)
    for name in ("2026-01-01", "2026-02-01"):
        Path(name, "checkpoints/checkpoint-10").mkdir(parents=True)
    # Of runs that died before their first checkpoint, and while it was written.
    Path("2026-03-01").mkdir()
    Path("2026-04-01/checkpoints/.checkpoint-10").mkdir(parents=True)
    assert Path(run_directory(resume, ".", "new")).resolve() == tmp_path / directory
    assert Path(run_directory("auto", "other", "new")) == Path("other/new")
    with pytest.raises(FileNotFoundError, match="resume=nowhere: there is nothing to resume from"):
        run_directory("nowhere", ".", "new")


def test_ctrl_c_and_resume_auto_as_a_user_types_them(tmp_path):
    command = [sys.executable, str(SCRIPTS / "ecpo/ecpo.py"), *RUNS["bandit"][1:3], "group_size=5"]
    command += ["total_trajectories=2000000"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as process:
        while not list(tmp_path.glob("runs/*/*/*/*/metrics.csv")):
            assert process.poll() is None, "the run has ended before its first record"
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        assert process.stdout is not None
        output = process.stdout.read()
    assert process.returncode == 128 + signal.SIGINT
    (directory,) = tmp_path.glob("runs/*/*/*/*")
    options = " ".join(command[2:])
    expected = f"Stopped by SIGINT. Resume with: python {command[1]} {options} resume={directory}"
    assert expected in output
    other = subprocess.run(
        [*command[:-1], "total_trajectories=60", "resume=auto"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "total_trajectories was 2000000, is 60" in other.stderr
    assert list(tmp_path.glob("runs/*/*/*/*")) == [directory]
