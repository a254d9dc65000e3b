"""The outside reference: a run of Stable-Baselines3 leaves what a run of ours leaves."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from processes import run_script

from torchrl_ecpo.envs import DeepSeaEnv
from torchrl_ecpo.experiment import compose_options, read_metrics

pytest.importorskip("sb3_contrib")
SB3 = Path(__file__).parents[1] / "sota-implementations/sb3/sb3.py"


def run_sb3(directory, *options):
    process = run_script(directory, SB3, f"hydra.run.dir={directory}", *options)
    assert process.returncode == 0, process.stderr
    return read_metrics(directory), json.loads((directory / "summary.json").read_text())


@pytest.mark.parametrize("task", ["frozenlake", "mountaincar", "minigrid", "popgym"])
def test_a_run_has_rows_of_so_many_episodes(tmp_path, task):
    metrics, summary = run_sb3(
        tmp_path, f"env={task}", "total_trajectories=20", "log_interval=10", "ppo.n_steps=16"
    )
    assert metrics["step"] == [10, 20]
    assert all(0 <= share <= 1 for share in metrics["pass_at_1"])
    assert metrics["entropy"][-1] > 0
    assert summary["finished"]
    assert summary["trajectories"] == 20


@pytest.mark.parametrize(
    "options",
    [
        ["env=cartpole", "method=dqn", "dqn.train_freq=64", "dqn.gradient_steps=1"],
        ["env=minatar", "ppo.n_steps=32"],
    ],
    ids=" ".join,
)
def test_a_run_has_rows_of_so_many_frames_and_ends_with_a_whole_one(tmp_path, options):
    if "env=minatar" in options:
        pytest.importorskip("minatar")
    metrics, summary = run_sb3(tmp_path, *options, "total_frames=700", "log_interval=400")
    assert metrics["step"] == [400, 800]
    assert metrics["length"][-1] > 1
    assert ("entropy" in metrics) == ("method=dqn" not in options)
    if "entropy" in metrics:  # of an action
        assert metrics["entropy"][-1] == pytest.approx(math.log(3), rel=0.05)
    assert ("pass_at_1" in metrics) == ("env=cartpole" in options)
    assert summary["finished"]
    assert summary["frames"] == 800


def test_frames_are_counted_where_a_step_of_all_copies_has_several_rows(tmp_path):
    options = ("env=cartpole", "n_envs=8", "log_interval=3", "total_frames=30", "ppo.n_steps=16")
    metrics, summary = run_sb3(tmp_path, *options)
    assert metrics["step"] == [6, 15, 24, 30]  # after 8, 16, 24 and 32 frames
    assert summary["frames"] == 30


def test_a_row_in_which_no_episode_ends_has_no_return(tmp_path):
    options = ("env=acrobot", "method=dqn", "dqn.gradient_steps=1", "dqn.train_freq=64")
    metrics, _ = run_sb3(tmp_path, *options, "total_frames=800", "log_interval=400")
    assert math.isnan(metrics["return"][0])
    assert -500 <= metrics["return"][1] < 0


def test_settings_that_fall_do_so(beside):
    sb3 = beside("sb3", "sb3")
    model = sb3.make_model(compose_options(SB3.parent, ["env=cartpole"]))
    assert model.lr_schedule(1.0) == pytest.approx(1e-3)
    assert model.lr_schedule(0.0) == 0
    assert model.clip_range(0.5) == pytest.approx(0.1)
    assert model.n_envs == 8


def test_a_run_without_entropy_ends_where_it_is_asked_to(tmp_path):
    options = ("env.size=2", "ppo.n_steps=16", "ppo.learning_rate=0.1", "log_interval=8")
    metrics, summary = run_sb3(tmp_path, *options, "stop_when.batches=2")
    assert summary["finished"]
    assert 0 < summary["trajectories"] < 40000
    assert max(metrics["entropy"][-2:]) < 0.1
    assert min(len(metrics["entropy"]), 3) == 2 or metrics["entropy"][-3] >= 0.1


def test_options_are_checked_and_a_run_is_not_resumed(tmp_path):
    for options, message in (
        (["env.solved=true"], "env.solved must be a number"),
        (["stop_when={batches:0}"], "stop_when.batches must be an integer >= 1"),
        (["env.max_steps=abc"], "env.max_steps must be an integer >= 1 or null, got 'abc'"),
    ):
        with pytest.raises(ValueError, match=message):
            compose_options(SB3.parent, options)
    for options, message in (
        ([f"resume={tmp_path}"], f"resume={tmp_path}: sb3.py writes no checkpoints"),
        (["env=frozenlake", "method=dqn"], "total_frames, which env.name=FrozenLake-v1 has not"),
        (["env=acrobot", "method=dqn", "env.name=Pendulum-v1"], "whose actions are Box: take"),
        (["env.name=Nothing-v0"], "env.name=Nothing-v0 is no task of gymnasium"),
    ):
        process = run_script(tmp_path, SB3, *options)
        assert process.returncode != 0
        assert message in process.stderr
        assert "Traceback" not in process.stderr


def test_the_deep_sea_is_the_one_of_the_groups(beside):
    sb3 = beside("sb3", "sb3")
    own, groups = sb3.DeepSea(4, instance_seed=3), DeepSeaEnv(4, instance_seed=3, group_size=20)
    torch.manual_seed(0)
    rollout = groups.rollout(4)
    for episode in rollout[0]:
        assert own.reset()[0] == episode["observation"][0]
        for step in episode:
            cell, reward, terminated, truncated, _ = own.step(int(step["action"]))
            assert cell == step["next", "observation"]
            assert reward == pytest.approx(step["next", "reward"].item())
            assert terminated == step["next", "terminated"].item()
            assert not truncated
    assert rollout["next", "reward"].max() > 0.9


def test_an_lstm_that_reads_episodes_at_once_is_that_which_steps(beside):
    sb3 = beside("sb3", "sb3")
    torch.manual_seed(0)
    lstm = torch.nn.LSTM(3, 4)
    features, states = torch.randn(5 * 6, 3), (torch.randn(1, 5, 4), torch.randn(1, 5, 4))
    for late in (False, True):  # a second episode in a row, which sb3-contrib's buffer never has
        starts = torch.zeros(5, 6)
        starts[[0, 3], 0] = 1
        starts[1, 2] = late
        found, expected = (
            policy._process_sequence(features, states, starts.flatten(), lstm)
            for policy in (sb3.EpisodeLstmPolicy, sb3.RecurrentActorCriticPolicy)
        )
        torch.testing.assert_close(found, expected)
        assert_same_gradients(lstm, found[0], expected[0])


def assert_same_gradients(module, *outputs):
    parameters = list(module.parameters())
    found, expected = (torch.autograd.grad(each.sin().sum(), parameters) for each in outputs)
    torch.testing.assert_close(found, expected)
