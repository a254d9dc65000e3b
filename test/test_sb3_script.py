"""The outside reference: PPO of Stable-Baselines3 leaves what a run of ours leaves."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from processes import run_script

from torchrl_ecpo.envs import DeepSeaEnv
from torchrl_ecpo.experiment import compose_options, read_metrics

pytest.importorskip("sb3_contrib")
PPO = Path(__file__).parents[1] / "sota-implementations/sb3/ppo.py"


def run_ppo(directory, *options):
    process = run_script(directory, PPO, f"hydra.run.dir={directory}", *options)
    assert process.returncode == 0, process.stderr
    return read_metrics(directory), json.loads((directory / "summary.json").read_text())


@pytest.mark.parametrize("task", ["frozenlake", "mountaincar", "minigrid", "popgym"])
def test_a_run_has_rows_of_so_many_episodes(tmp_path, task):
    metrics, summary = run_ppo(
        tmp_path, f"env={task}", "total_trajectories=20", "log_interval=10", "ppo.n_steps=16"
    )
    assert metrics["step"] == [10, 20]
    assert all(0 <= share <= 1 for share in metrics["pass_at_1"])
    assert metrics["entropy"][-1] > 0
    assert summary["finished"]
    assert summary["trajectories"] == 20


def test_a_run_without_entropy_ends_where_it_is_asked_to(tmp_path):
    options = ("env.size=2", "ppo.n_steps=16", "ppo.learning_rate=0.1", "log_interval=8")
    metrics, summary = run_ppo(tmp_path, *options, "stop_when.batches=2")
    assert summary["finished"]
    assert 0 < summary["trajectories"] < 40000
    assert max(metrics["entropy"][-2:]) < 0.1
    assert min(len(metrics["entropy"]), 3) == 2 or metrics["entropy"][-3] >= 0.1


def test_options_are_checked_and_a_run_is_not_resumed(tmp_path):
    for options, message in (
        (["env.solved=true"], "env.solved must be a number"),
        (["stop_when={batches:0}"], "stop_when.batches must be an integer >= 1"),
    ):
        with pytest.raises(ValueError, match=message):
            compose_options(PPO.parent, options)
    process = run_script(tmp_path, PPO, f"resume={tmp_path}")
    assert f"ppo.py: resume={tmp_path}: ppo.py writes no checkpoints" in process.stderr


def test_the_deep_sea_is_the_one_of_the_groups(beside):
    ppo = beside("sb3", "ppo")
    own, groups = ppo.DeepSea(4, instance_seed=3), DeepSeaEnv(4, instance_seed=3, group_size=20)
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
    ppo = beside("sb3", "ppo")
    torch.manual_seed(0)
    lstm = torch.nn.LSTM(3, 4)
    features, states = torch.randn(5 * 6, 3), (torch.randn(1, 5, 4), torch.randn(1, 5, 4))
    for late in (False, True):  # a second episode in a row, which sb3-contrib's buffer never has
        starts = torch.zeros(5, 6)
        starts[[0, 3], 0] = 1
        starts[1, 2] = late
        found, expected = (
            policy._process_sequence(features, states, starts.flatten(), lstm)
            for policy in (ppo.EpisodeLstmPolicy, ppo.RecurrentActorCriticPolicy)
        )
        torch.testing.assert_close(found, expected)
        assert_same_gradients(lstm, found[0], expected[0])


def assert_same_gradients(module, *outputs):
    parameters = list(module.parameters())
    found, expected = (torch.autograd.grad(each.sin().sum(), parameters) for each in outputs)
    torch.testing.assert_close(found, expected)
