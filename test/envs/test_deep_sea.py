from __future__ import annotations

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from torchrl_ecpo.envs import DeepSeaEnv


def play(env, moves):
    """Rewards and cells of the copies ``[K]`` of one row; of each the steps to the right, as 1."""
    moves = torch.tensor(moves).T.unsqueeze(1)  # [T, 1, K]
    td, rewards, cells = env.reset(), [], []
    for is_right in moves:
        cells.append(td["observation"][0].tolist())
        right = env.right[td["observation"]]
        td["action"] = right.where(is_right == 1, 1 - right)
        after = env.step(td)["next"]
        rewards.append(after["reward"].flatten())
        td = after.exclude("reward")
    return torch.stack(rewards, -1), cells, td


def test_specs():
    check_env_specs(DeepSeaEnv(3, num_groups=2, group_size=3), break_when_any_done="both")


def test_moves_and_rewards_by_hand():
    env = DeepSeaEnv(3, instance_seed=1, group_size=3)
    moves = [[1, 1, 1], [0, 1, 1], [1, 0, 0]]
    rewards, cells, after = play(env, moves)
    cost = 0.01 / 3
    expected = [[-cost, -cost, 1 - cost], [0, -cost, -cost], [-cost, 0, 0]]
    torch.testing.assert_close(rewards, torch.tensor(expected))
    # Row by row, the left edge stops whoever moves left there.
    assert cells == [[0, 0, 0], [4, 3, 4], [8, 7, 6]]
    assert after["done"].all()
    assert after["terminated"].all()
    assert (after["observation"] == 9).all()


def test_the_best_return_and_that_of_who_never_moves_right():
    for size in (10, 30):
        env = DeepSeaEnv(size, group_size=2)
        rewards, _, _ = play(env, [[1] * size, [0] * size])
        torch.testing.assert_close(rewards.sum(-1), torch.tensor([0.99, 0.0]))


def test_which_action_moves_right_differs_by_cell_and_is_the_seed_s():
    first, again, other = (DeepSeaEnv(10, instance_seed=s).right for s in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert set(first.tolist()) == {0, 1}


def test_copies_that_are_not_reset_stay_where_they_are():
    env = DeepSeaEnv(3, group_size=2)
    td = env.rand_step(env.reset())["next"].exclude("reward")
    before = td["observation"].clone()
    td["_reset"] = torch.tensor([[[True], [False]]])
    assert env.reset(td)["observation"].tolist() == [[0, before[0, 1]]]


def test_episodes_follow_each_other():
    """TorchRL's resets within a rollout know which copies are over, and nothing else."""
    env = DeepSeaEnv(3, group_size=2)
    cells = env.rollout(8, break_when_any_done=False)["observation"]
    assert (cells == 0).nonzero()[:, -1].tolist() == 2 * [0, 3, 6]


@pytest.mark.parametrize(("key", "value"), [("action", 2), ("observation", 10), ("action", -1)])
def test_what_does_not_exist_is_refused(key, value):
    env = DeepSeaEnv(3, group_size=2)
    td = env.rand_action(env.reset())
    td[key] = torch.full_like(td[key], value)
    with pytest.raises(ValueError, match=f"Each '{key}' must be an integer from 0 to"):
        env.step(td)
