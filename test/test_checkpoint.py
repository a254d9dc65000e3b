"""A run that was stopped and resumed is the run that was never stopped, number for number."""

from __future__ import annotations

import io
import json
import os
import pickle
import shlex
import shutil
import signal
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from processes import (
    assert_same_run,
    checkpoints,
    contents,
    last_state,
    record,
    run_script,
    start_script,
)
from tensordict import NonTensorData, TensorDict
from torchrl.checkpoint import Checkpoint, CheckpointError
from torchrl.envs import DMControlEnv, GymEnv, TransformedEnv

from torchrl_ecpo import ECPOLoss
from torchrl_ecpo.envs import EpisodeReplay
from torchrl_ecpo.experiment import Checkpoints, Progress, Run
from torchrl_ecpo.experiment import run as run_module
from torchrl_ecpo.experiment._files import check_files, read_manifest, seal
from torchrl_ecpo.experiment.checkpoint import _differences, run_directory

SCRIPTS = Path(__file__).parents[1] / "sota-implementations"
BANDIT = ("ecpo", "env=bandit", "env.num_actions=20", "total_trajectories=60", "group_size=5")
ALGORITHMIC = ("num_groups=2", "group_size=8", "policy.hidden_size=8", "evaluation.interval=2")
CONTROL = (
    "ecac",
    "total_frames=200",
    "log_interval=40",
    "evaluation.interval=80",
    "evaluation.episodes=1",
    "collector.init_random_frames=80",
    "hidden_sizes=[16,16]",
    "replay_buffer.batch_size=16",
)
ECAC_STATES = "loss.num_actor_states=8"
RUNS = {
    "bandit": BANDIT,
    "copy": ("ecpo", "env=copy", "total_trajectories=192", "project_steps=2", *ALGORITHMIC),
    "cartpole": (
        *("ecpo", "env=gym", "total_trajectories=96", "env.max_steps=20"),
        *("num_groups=2", "group_size=8", "evaluation.interval=2"),
    ),
    "hopper": (
        *(*CONTROL, "env=hopper", ECAC_STATES),
        *("loss.reference_interval=5", "replay_buffer.size=100", "updates_per_frame=0.5"),
    ),
    "memmap": (
        *(*CONTROL, "env=pendulum", "loss=td3", "replay_buffer.storage=memmap"),
        *("updates_per_frame=0.1", "log_interval=8"),  # rows between updates
    ),
}


@pytest.fixture
def start(run_here, monkeypatch):
    """Runs a script in this process, in a directory: up to a boundary, or to its end."""

    def start(directory, script, *options, stop_at=None, kill_at=None, save_at=None):
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

        with monkeypatch.context() as patch:
            patch.setattr(Checkpoints, "boundary", counted)
            run_here(directory, script, *options)

    return start


class Killed(Exception):
    """Ends a run with nothing but what is on the disk."""


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
    typed = ("checkpoint.interval=null", *run[1:])
    command = shlex.join(["python", sys.argv[0], *typed, f"resume={parts}"])
    assert f"Resume with: {command}" in capfd.readouterr().out
    with pytest.raises(Killed):
        start(parts, *run, f"resume={parts}", save_at=1, kill_at=second - first + 1)
    assert len(record(parts)) < len(record(whole))
    start(parts, *run, f"resume={parts}")
    assert_same_run(parts, whole)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Where runs are kept that several tests begin with, or compare with."""
    return tmp_path_factory.mktemp("made")


@pytest.fixture
def interrupted(tmp_path, start, made):
    """The directory of a run with a checkpoint, which was killed two rows later."""
    if not (made / "interrupted").exists():
        with pytest.raises(Killed):
            start(made / "interrupted", *RUNS["bandit"], save_at=4, kill_at=6)
    return shutil.copytree(made / "interrupted", tmp_path, dirs_exist_ok=True)


@pytest.fixture
def left_alone(start, made):
    """The directory of a run of the bandit that was never stopped, with these options."""

    def left_alone(*options):
        directory = made / "_".join(["whole", *options])
        if not directory.exists():
            start(directory, *RUNS["bandit"], *options)
        return directory

    return left_alone


def test_a_full_disk_ends_the_run_and_leaves_the_last_checkpoint(
    interrupted, left_alone, start, monkeypatch
):
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
    assert_same_run(interrupted, left_alone())


def flip_a_bit(directory):
    (path,) = checkpoints(directory)
    file = next(path.glob("components/*loss_module/state.pt"))
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def make_foreign(directory):
    Checkpoint(value={"step": 1}).save(checkpoints(directory)[0])


def remove_checkpoints(directory):
    shutil.rmtree(directory / "checkpoints")


def cut_record(directory):
    path = directory / "metrics.csv"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:3]))


def change_record(directory):
    path = directory / "metrics.csv"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join([*lines[:2], lines[2].replace(".", ".1", 1), *lines[3:]]))


@pytest.mark.parametrize(
    ("spoil", "options", "message"),
    [
        (flip_a_bit, (), "checkpoint-0*20 is damaged: .*loss_module/state.pt has changed"),
        (remove_checkpoints, (), "nothing to resume from, for .*checkpoints holds no checkpoint"),
        (make_foreign, (), "checkpoint-0*20 is no checkpoint of a run of this script"),
        (cut_record, (), "metrics.csv does not reach to step 20"),
        (change_record, (), "metrics.csv does not reach to step 20, .* with the rows that were"),
        (
            None,
            ("loss.tau=1", "seed=7"),
            "loss.tau was [0-9.]+, is 1; seed was 0, is 7. Resume with",
        ),
        (None, ("resume=elsewhere",), "resume=elsewhere is not this run's directory"),
    ],
)
def test_what_cannot_be_resumed_is_refused(interrupted, start, spoil, options, message):
    if spoil is not None:
        spoil(interrupted)
    before = contents(interrupted)
    with pytest.raises((CheckpointError, ValueError), match=message):
        start(interrupted, *RUNS["bandit"], f"resume={interrupted}", *options)
    assert contents(interrupted) == before


@pytest.mark.parametrize("value", [np.mean([1, 2]), np.zeros(2), [{"a": np.int64(1)}]], ids=str)
def test_what_could_not_be_read_is_not_written(tmp_path, value):
    """As Python takes numpy's numbers for its own; the message comes before anything is lost."""
    written = attach(tmp_path, net=torch.nn.Linear(1, 1))
    written.progress.frames = 5
    written.save()
    written.progress.frames, written.progress.returns = 6, [value]
    with pytest.raises(CheckpointError, match=r"state of Progress must be .*numpy.*\.item\(\)"):
        written.save()
    assert [path.name for path in checkpoints(tmp_path)] == ["checkpoint-000000000005"]
    assert attach(tmp_path, "auto", net=torch.nn.Linear(1, 1)).step == 5


def attach(directory, resume=None, keep=2, total_frames=100, **parts):
    """Checkpoints of a run that the test itself is."""
    logger = {"backend": "csv", "project": "test", "wandb_mode": "offline"}
    options = {"interval": None, "max_share": 1, "keep": keep}
    config = OmegaConf.create(
        {
            "seed": 0,
            "total_frames": total_frames,
            "resume": resume,
            "checkpoint": options,
            "logger": logger,
        }
    )
    found = Checkpoints(config, directory)
    run = Run(
        config, total=100, unit="frames", name="test", shown=[], directory=directory, show_bar=False
    )
    return found.attach(run, Progress(frames=0, returns=[]), **parts)


def save(written, step, **options):
    written.progress.frames = step
    written.run.log({"return": 0.5}, step)
    written.save(**options)


def state_file(path):
    return path / Checkpoint.manifest(path)["components"]["net"]["path"] / "state.pt"


class Evil:
    """Makes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def put_folder_for_file(path):
    """TorchRL's own reader unpickles what is in such a folder."""
    file = state_file(path)
    file.unlink()
    evil = NonTensorData(data=Evil(path.parents[1] / "evil"))
    TensorDict({"weight": torch.zeros(2, 2), "bias": evil}).memmap_(file.parent / "state")
    (file.parent / "state.json").write_text('{"kind": "dict", "items": []}')


def put_pickle(path):
    state_file(path).write_bytes(pickle.dumps({"weight": Evil(path.parents[1] / "evil")}))


def put_older_file(path):
    shutil.copy(state_file(path.with_name("checkpoint-000000000005")), state_file(path))


def change_manifest(path):
    manifest = path / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"step": 10', '"step": 11'))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: state_file(path).write_bytes(b""), "net/state.pt has changed"),
        (lambda path: state_file(path).unlink(), "net/state.pt is missing"),
        (put_older_file, "net/state.pt has changed"),
        (lambda path: (path / "notes").touch(), "notes does not belong to it"),
        (lambda path: (path / "components/more").mkdir(), "components/more does not belong to it"),
        (lambda path: (path / "manifest.json").unlink(), "manifest.json is missing"),
        (lambda path: (path / "manifest.json").write_text("{"), "manifest.json is missing or"),
        (change_manifest, "manifest.json has changed"),
        (put_pickle, "net/state.pt has changed"),
        (put_folder_for_file, "net/state.pt is missing, .*net/state does not belong to it"),
    ],
)
def test_a_damaged_checkpoint_is_refused_and_left_as_it_is(tmp_path, damage, message):
    net = torch.nn.Linear(2, 2)
    written = attach(tmp_path, net=net)
    save(written, 5)
    with torch.no_grad():
        net.weight.zero_()
    save(written, 10)
    damage(written.latest)
    before = contents(tmp_path)
    for resume in ("auto", str(tmp_path)):
        with pytest.raises(CheckpointError, match=rf"checkpoint-0*10 is damaged: .*{message}"):
            attach(tmp_path, resume, net=net)
    assert contents(tmp_path) == before
    assert not (tmp_path / "evil").exists()
    # The message says what helps: the one before it.
    shutil.rmtree(written.latest)
    assert attach(tmp_path, "auto", net=net).step == 5
    assert net.weight.any()


@pytest.mark.filterwarnings("ignore:TensorDict.load_memmap is loading a pickled")
@pytest.mark.parametrize("put", [put_pickle, put_folder_for_file])
def test_reading_runs_no_code_even_where_hashes_agree(tmp_path, put):
    written = attach(tmp_path, net=torch.nn.Linear(2, 2))
    save(written, 5)
    put(written.latest)
    seal(written.latest)
    with pytest.raises(CheckpointError, match=r"cannot be restored: .*'net'"):
        attach(tmp_path, "auto", net=torch.nn.Linear(2, 2))
    assert not (tmp_path / "evil").exists()


@pytest.mark.parametrize("keep", [1, 2])
def test_there_is_a_whole_checkpoint_at_every_moment(tmp_path, monkeypatch, keep):
    written = attach(tmp_path, keep=keep, net=torch.nn.Linear(2, 2), replay_buffer=Progress(x=1))
    save(written, 5)
    kept = []

    def watched(call):
        def look(*args, **options):
            result = call(*args, **options)
            check_files(written.latest, read_manifest(written.latest))
            kept.append(len(list((tmp_path / "checkpoints").glob("checkpoint-*"))))
            return result

        return look

    for owner, name in ((Path, "rename"), (os, "replace"), (shutil, "rmtree")):
        monkeypatch.setattr(owner, name, watched(getattr(owner, name)))
    save(written, 10)
    save(written, 15)
    written.save(finished=True)  # of the same step, without the replay buffer
    assert (min(kept), max(kept), kept[-1]) == (1, keep + 1, 1)
    assert written.latest.name == "checkpoint-000000000015-finished"


def test_what_a_killed_write_has_left_is_removed(tmp_path, monkeypatch):
    written = attach(tmp_path, net=torch.nn.Linear(2, 2))
    save(written, 5)

    def kill(*_, **__):
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr("torchrl_ecpo.experiment.checkpoint.seal", kill)
        with pytest.raises(Killed):
            save(written, 10)
    (tmp_path / "checkpoints/..checkpoint-000000000010.stage-0").mkdir()  # TorchRL's
    assert written.latest.name == "checkpoint-000000000005"
    save(written, 15)
    names = [path.name for path in checkpoints(tmp_path)]
    assert names == ["checkpoint-000000000005", "checkpoint-000000000015"]


def test_saved_counters_are_not_shared_with_the_run():
    progress, other = Progress(returns=[1.0]), Progress(returns=[])
    state = progress.state_dict()
    progress.returns.append(2.0)
    other.load_state_dict(state)
    other.returns.append(3.0)
    assert state == {"returns": [1.0]}


def test_counters_that_are_no_integers_are_refused(tmp_path):
    found = attach(tmp_path)
    message = r"progress\.frames must be an integer of at least 0, got 0\.5"
    with pytest.raises(ValueError, match=message):
        found.attach(found.run, Progress(frames=0.5))


def test_options_in_which_the_same_run_may_differ():
    old = {
        "seed": 0,
        "compile": False,
        "resume": None,
        "checkpoint": {"keep": 2},
        "total_frames": 9,
    }
    new = {"seed": 0, "compile": True, "resume": "auto", "checkpoint": None, "total_frames": 10}
    assert _differences(old, new) == []
    assert _differences(new, old) == ["total_frames was 10, is 9"]


def test_a_summary_is_gone_once_its_run_goes_on(tmp_path):
    """A run that is prolonged, and killed before its next row, has not finished."""
    run = attach(tmp_path)
    with run.run, run:
        save(run, 5)
    assert (tmp_path / "summary.json").exists()
    resumed = attach(tmp_path, "auto", total_frames=200)
    assert not (tmp_path / "summary.json").exists()
    with resumed.run, resumed:
        pass
    assert json.loads((tmp_path / "summary.json").read_text())["frames"] == 5


def test_a_run_that_goes_on_with_other_versions_keeps_those_before(tmp_path, monkeypatch):
    for resume, torch_version in ((None, "1"), ("auto", "1"), ("auto", "2"), ("auto", "1")):
        made_with = {"torch": torch_version}
        monkeypatch.setattr(run_module, "_versions", made_with.copy)
        run = attach(tmp_path, resume)
        if resume is None:
            save(run, 5)
    versions = json.loads((tmp_path / "versions.json").read_text())
    assert versions == {"torch": "1", "earlier": [{"torch": "1"}, {"torch": "2"}]}
    assert len((tmp_path / "command.txt").read_text().splitlines()) == 4
    attach(tmp_path)
    assert json.loads((tmp_path / "versions.json").read_text()) == {"torch": "1"}
    assert len((tmp_path / "command.txt").read_text().splitlines()) == 1
    assert not (tmp_path / "metrics.csv").exists()


def test_a_worker_that_ends_by_the_same_signal_is_no_failure(tmp_path, capsys):
    """A cluster sends SIGTERM to the whole group of processes."""
    run = attach(tmp_path)
    run.run.log({"return": 0.5}, 5)
    run.progress.frames = 5

    def stopped():
        with run:
            os.kill(os.getpid(), signal.SIGTERM)
            raise ChildProcessError("A worker has died.")

    with pytest.raises(SystemExit) as stop:
        stopped()
    assert stop.value.code == 128 + signal.SIGTERM
    assert "Stopped by SIGTERM. Resume with: " in capsys.readouterr().out
    assert [path.name for path in checkpoints(tmp_path)] == ["checkpoint-000000000005"]


def test_a_second_signal_does_not_wait(tmp_path):
    # A shell lets what it starts in the background ignore SIGINT.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    with attach(tmp_path):
        os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("save_at", [None, 1])
def test_a_new_run_in_an_old_directory_forgets_the_old_one(
    interrupted, left_alone, start, capfd, save_at
):
    """One that is killed before its first checkpoint is begun again."""
    with pytest.raises(Killed):
        start(interrupted, *RUNS["bandit"], "seed=8", save_at=save_at, kill_at=2)
    folder = interrupted / "checkpoints"
    kept = [path.name[-2:] for path in folder.iterdir()] if folder.exists() else []
    assert kept == (["05"] if save_at else [])
    start(interrupted, *RUNS["bandit"], "seed=8", "resume=auto")
    begins = "resume=auto found no checkpoint: a new run begins" in capfd.readouterr().out
    assert begins is (save_at is None)
    assert_same_run(interrupted, left_alone("seed=8"))


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


def test_a_finished_run_can_be_prolonged(tmp_path, start):
    longer = (*RUNS["bandit"], "total_trajectories=90", "checkpoint.keep=1")
    start(tmp_path, *RUNS["bandit"])
    start(tmp_path, *longer, "resume=auto")
    start(tmp_path / "whole", *longer)
    assert_same_run(tmp_path, tmp_path / "whole")


def test_a_finished_run_stays_as_it_is(tmp_path, start, capfd):
    run = (*CONTROL, "env=pendulum", ECAC_STATES, "total_frames=120")
    start(tmp_path, *run)
    rows, (path,) = record(tmp_path), checkpoints(tmp_path)
    assert "replay_buffer" not in Checkpoint.manifest(path)["components"]
    start(tmp_path, *run, "resume=auto")
    assert record(tmp_path) == rows
    assert checkpoints(tmp_path) == [path]
    assert "which had finished" in capfd.readouterr().out
    # Nor can it be prolonged, for the buffer is gone.
    with pytest.raises(CheckpointError, match="had finished, and has no replay_buffer: begin a"):
        start(tmp_path, *run, "total_frames=160", "resume=auto")
    assert record(tmp_path) == rows


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
        "parameter": "log-probability .* under the actor is NaN or infinite",
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
    # One that a user has put aside.
    Path("2026-05-01/checkpoints/checkpoint-10.bad").mkdir(parents=True)
    assert Path(run_directory(resume, ".", "new")).resolve() == tmp_path / directory
    assert Path(run_directory("auto", "other", "new")) == Path("other/new")


def test_ctrl_c_and_resume_auto_as_a_user_types_them(tmp_path):
    own = tmp_path / "mine/env/own.yaml"
    own.parent.mkdir(parents=True)
    own.write_text("# @package _global_\ndefaults: [bandit, _self_]\n")
    options = ("--config-dir", "mine", "env=own", *RUNS["bandit"][1:3], "group_size=5")
    script = SCRIPTS / "ecpo/ecpo.py"
    process = start_script(tmp_path, script, *options, "total_trajectories=2000000")
    while not list(tmp_path.glob("runs/*/*/*/*/metrics.csv")):
        assert process.is_alive(), "the run has ended before its first record"
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGINT)
    process.join()
    assert process.exitcode == 128 + signal.SIGINT
    (directory,) = tmp_path.glob("runs/*/*/*/*")
    typed = f"python {script} {' '.join(options)} total_trajectories=2000000"
    expected = f"Stopped by SIGINT. Resume with: {typed} resume={directory}"
    assert expected in (tmp_path / ".stdout").read_text()
    other = run_script(tmp_path, script, *options, "total_trajectories=60", "resume=auto")
    assert "total_trajectories was 2000000, is 60" in other.stderr
    assert list(tmp_path.glob("runs/*/*/*/*")) == [directory]
