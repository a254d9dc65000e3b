from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Categorical
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_ecpo.modules import LinearSoftmax, SharedCategorical, make_softmax_policy


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_shared_categorical_equals_a_categorical(batch, dtype):
    row = torch.randn(5, dtype=dtype)
    rows = row.expand(*batch, 5)
    shared, plain = SharedCategorical(rows), Categorical(logits=rows)
    actions = plain.sample()
    torch.testing.assert_close(shared.log_prob(actions), plain.log_prob(actions))
    torch.testing.assert_close(shared.entropy(), plain.entropy())
    torch.testing.assert_close(shared.probs, plain.probs)
    assert torch.equal(shared.mode, plain.mode)
    assert shared.sample().shape == batch
    assert shared.sample((4,)).shape == (4, *batch)


def test_samples_follow_the_probabilities():
    torch.manual_seed(0)
    probabilities = torch.tensor([0.1, 0.2, 0.7])
    sample = SharedCategorical(probabilities.log().expand(50_000, 3)).sample()
    shares = sample.bincount(minlength=3) / 50_000
    # Four standard errors of the widest share.
    torch.testing.assert_close(shares, probabilities, atol=4 * 0.5 / 50_000**0.5, rtol=0)


def test_gradient_is_that_of_a_softmax():
    features = torch.randn(6, 3, dtype=torch.float64)
    policy = make_softmax_policy(features)
    action = torch.tensor([1, 4, 4, 0])
    dist = policy.get_dist(TensorDict({"observation": torch.ones(4, 1)}, [4]))
    dist.log_prob(action).sum().backward()
    (theta,) = policy.parameters()
    expected = (features[action] - features.mean(0)).sum(0)  # at theta = 0: uniform
    torch.testing.assert_close(theta.grad, expected)


def test_deterministic_action_is_the_mode():
    policy = make_softmax_policy(torch.eye(4))
    with torch.no_grad():
        next(policy.parameters()).copy_(torch.tensor([0.0, 2.0, 1.0, 0.0]))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        action = policy(TensorDict({"observation": torch.ones(3, 1)}, [3]))["action"]
    assert action.tolist() == [1, 1, 1]


def test_reset_parameters_gives_the_uniform_policy():
    module = LinearSoftmax(torch.randn(4, 2))
    torch.nn.init.ones_(module.theta)
    module.reset_parameters()
    assert not module(torch.ones(1)).any()


def test_features_are_the_policys_own():
    """A state dict is loaded into them, not into the environment's."""
    features = torch.eye(3)
    policy = make_softmax_policy(features)
    policy.load_state_dict(make_softmax_policy(2 * torch.eye(3)).state_dict())
    assert torch.equal(features, torch.eye(3))
