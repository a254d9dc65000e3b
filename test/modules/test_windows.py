from __future__ import annotations

from itertools import product
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch.nn import functional as F
from torch.testing import assert_close
from torchrl.envs import TransformedEnv
from torchrl.modules import get_env_transforms_from_module, set_recurrent_mode

from torchrl_ecpo import ECPOLoss
from torchrl_ecpo.collectors import TrajectoryGroupCollector
from torchrl_ecpo.envs import AlgorithmicEnv
from torchrl_ecpo.modules import (
    DistinctWindowNetwork,
    OneHotLinear,
    TupleTables,
    make_tuple_policy,
    windows,
)

NUM_CLASSES = (3, 2)
ROWS, STEPS = 8, 7
IS_TABULAR = [False, True]
exactly = {"rtol": 0, "atol": 0}


def make_network(window: int) -> DistinctWindowNetwork:
    torch.manual_seed(0)
    network = torch.nn.Sequential(
        OneHotLinear(NUM_CLASSES * window, 5),
        torch.nn.Tanh(),
        torch.nn.Linear(5, 2),
    ).double()
    return DistinctWindowNetwork(NUM_CLASSES, network, window, in_keys=["inputs"])


def dense_output(network: DistinctWindowNetwork, one_hots: torch.Tensor) -> torch.Tensor:
    layers: Any = network.network
    return layers[1:](F.linear(one_hots, layers[0].weight, layers[0].bias))


@pytest.fixture(params=IS_TABULAR, ids=["unique", "tabular"])
def is_tabular(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    monkeypatch.setattr(windows, "FEW", 10**5 if request.param else 0)
    return request.param


def sequences() -> TensorDict:
    """Rows of several lengths, some of which start anew in between."""
    generator = torch.Generator().manual_seed(0)
    classes = [torch.randint(n, (ROWS, STEPS), generator=generator) for n in NUM_CLASSES]
    starts = torch.zeros(ROWS, STEPS, 1, dtype=torch.bool)
    starts[:, 0] = True
    starts[2:5, 3] = starts[4, 4] = starts[5, 6] = True
    lengths = torch.tensor([7, 1, 4, 7, 6, 7, 5, 0])
    data = TensorDict(inputs=torch.stack(classes, -1), is_init=starts, batch_size=[ROWS, STEPS])
    return data.set(("collector", "mask"), torch.arange(STEPS) < lengths.unsqueeze(1))


def dense_windows(data: TensorDict, window: int) -> torch.Tensor:
    """The one-hot windows, present step first, zeros where a place is empty or padded."""
    parts = zip(data["inputs"].unbind(-1), NUM_CLASSES, strict=True)
    hot = torch.cat([F.one_hot(x, n) for x, n in parts], -1).double()
    dense = hot.new_zeros(*data.shape, window, hot.shape[-1])
    for n, t in product(range(ROWS), range(STEPS)):
        for lag in range(window if data["collector", "mask"][n, t] else 0):
            dense[n, t, lag] = hot[n, t - lag]
            if data["is_init"][n, t - lag]:
                break
    return dense.flatten(2)


@pytest.mark.parametrize("window", [1, 2, 3, 5])
def test_recurrent_mode_equals_the_dense_network(window: int, is_tabular: bool) -> None:
    network, data = make_network(window), sequences()
    assert network.is_tabular == is_tabular
    inputs = dense_windows(data, window)
    rows: list[int] = []
    network.network.register_forward_hook(lambda module, args, out: rows.append(len(out)))
    with set_recurrent_mode(True):
        output = network(data.clone())["embed"]
    assert rows == [7**window if is_tabular else len(inputs.flatten(0, 1).unique(dim=0))]
    expected = dense_output(network, inputs)
    assert_close(output, expected)
    weights = torch.randn(output.shape, dtype=output.dtype)
    parameters = list(network.parameters())
    gradients = (
        torch.autograd.grad((x.sin() * weights).sum(), parameters) for x in (output, expected)
    )
    for ours, plain in zip(*gradients, strict=True):
        assert plain.abs().max() > 1e-3
        assert_close(ours, plain, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("window", [1, 3])
def test_pasts_are_read_out_by_the_weights_of_then(window: int, is_tabular: bool) -> None:
    network, data = make_network(window), sequences()
    with set_recurrent_mode(True):
        pasts = network.read(data).pasts
        for parameter in network.parameters():
            parameter.data.mul_(1.5)
        expected = network.read(data).output
    assert pasts is not None
    assert_close(network.read_out(pasts), expected)


@pytest.mark.parametrize("window", [1, 2, 3, 5])
def test_step_by_step_equals_recurrent_mode(window: int, is_tabular: bool) -> None:
    """Rows are reordered on the way: what the window holds travels with them."""
    network, data = make_network(window), sequences()
    data["collector", "mask"][:] = True
    with set_recurrent_mode(True):
        expected = network(data.clone())["embed"]
    if window == 1:
        del data["is_init"]
    order, before = torch.arange(ROWS), None
    for t in range(STEPS):
        step = data[order, t].exclude("collector")
        if before is not None and window > 1:
            step["window"] = before["next", "window"]
        before = network(step)
        assert_close(before["embed"], expected[order, t], **exactly)
        assert (("next", "window") in before.keys(True)) == (window > 1)
        shuffle = torch.randperm(ROWS)
        order, before = order[shuffle], before[shuffle]


def test_rows_that_have_ended_are_alike() -> None:
    network = make_network(2)
    step = sequences()[:, 2].exclude("collector")
    step["window"] = torch.arange(ROWS).unsqueeze(1) % 7
    step["done"] = torch.arange(ROWS).unsqueeze(1) > 2
    embed, others = network(step)["embed"], network(step.exclude("done"))["embed"]
    assert (embed[3:] == embed[3]).all()
    assert (others[3:] != others[3]).any()
    assert_close(embed[:3], others[:3])


POLICIES = [1, 2, None]  # those of two steps are too many for a table; None: the LSTM


def copy_policy(window: int | None, **options: Any) -> Any:
    torch.manual_seed(0)
    return make_tuple_policy(6, (2, 2, 5), hidden_size=16, window=window, **options)


def copy_step() -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    previous = [torch.randint(n, (20,), generator=generator) for n in (3, 3, 6)]
    return TensorDict(
        observation=torch.randint(6, (20,), generator=generator),
        previous_action=torch.stack(previous, -1),
        is_init=torch.ones(20, 1, dtype=torch.bool),
        batch_size=[20],
    )


def act(policy: Any) -> dict[Any, Any]:
    torch.manual_seed(1)
    with torch.no_grad():
        return policy(copy_step()).to_dict()


@pytest.mark.parametrize("window", POLICIES)
def test_constant_weights_change_no_number_and_are_forgotten(window: int | None) -> None:
    policy = copy_policy(window)
    expected = act(policy)
    rows: list[int] = []
    core = policy.module[0]
    last = core.readout if window is None else core.network
    last.register_forward_hook(lambda *args: rows.append(len(args[-1])))
    with torch.no_grad(), policy.constant_weights():
        assert rows == ([6 * 3 * 3 * 6 + 1] if window == 1 else [])
        for _ in range(2):
            assert_close(act(policy), expected, **exactly)
        assert len(rows) == (1 if window == 1 else 2)
    with pytest.raises(RuntimeError, match="on the way"), policy.constant_weights():
        raise RuntimeError("on the way")
    for parameter in policy.parameters():
        parameter.data.mul_(2)
    twice = copy_policy(window)
    twice.load_state_dict(policy.state_dict())
    expected_now = act(twice)
    assert (expected_now["logits"] != expected["logits"]).all()
    assert_close(act(policy), expected_now, **exactly)
    with policy.constant_weights():
        assert_close(act(policy), expected_now, **exactly)


def test_a_policy_without_memory_needs_nothing_of_the_environment() -> None:
    policy = copy_policy(1)
    assert policy.in_keys == ["observation", "previous_action"]
    assert set(policy.out_keys) == {"logits", "action", "action_log_prob"}
    env = AlgorithmicEnv("copy", num_groups=2, group_size=3, seed=0)
    for each in (env, TransformedEnv(env, get_env_transforms_from_module(policy))):
        data = each.rollout(10, policy, break_when_any_done=False)
        with set_recurrent_mode(True):
            log_prob = policy.get_dist(data).log_prob(data["action"])
        assert_close(log_prob, data["action_log_prob"])


@pytest.mark.parametrize("window", [1, 4])
def test_the_loss_finds_the_probabilities_that_were_sampled(window: int) -> None:
    env = AlgorithmicEnv("copy", min_length=4, num_groups=6, group_size=5, seed=0)
    policy = copy_policy(window)
    collector = TrajectoryGroupCollector(env, policy, num_groups=6, group_size=5)
    loss = ECPOLoss(policy, tau=0.5, tau_prime=0.01)
    batches = iter(collector)
    for is_copied in (True, False, True):
        if is_copied:
            collector.update_policy_weights_()
        else:
            for parameter in policy.parameters():
                parameter.data.mul_(2)
        groups = next(batches)
        assert "window" not in groups
        assert groups["collector", "mask"][..., window:].any()
        divergence = loss(groups)["kl_reference_policy"]
        assert (divergence.abs() < 1e-6) == is_copied
    collector.shutdown()


def test_windows_that_cannot_be_counted() -> None:
    message = r"window: expected at most 2\^62 different windows, got 325\^8"
    with pytest.raises(ValueError, match=message):
        copy_policy(8)


def test_what_a_step_lacks_is_named() -> None:
    network, step = make_network(2), sequences()[:, 1].exclude("collector")
    with pytest.raises(KeyError, match="expected the states of rows that continue"):
        network(step)
    with pytest.raises(KeyError, match="is_init: expected the key"):
        network(step.exclude("is_init"))
    with set_recurrent_mode(True), pytest.raises(ValueError, match="keep trajectories whole"):
        network(sequences()[:, 1:])


@pytest.mark.parametrize(
    ("classes", "match"),
    [
        (torch.tensor([[3, 0]]), r"integers from -1 to \[2, 1\], got values from \[3, 0\]"),
        (torch.tensor([[0, -2]]), r"integers from -1 to \[2, 1\], got values from \[0, -2\]"),
        (torch.zeros(4, 3, dtype=torch.int64), r"of 2 integers in a row.*int64 \(4, 3\)"),
        (torch.zeros(2, dtype=torch.int64), r"of 2 integers in a row.*int64 \(2,\)"),
        (torch.zeros(4, 2), "'classes' must hold integers, got torch.float32"),
    ],
    ids=str,
)
def test_what_is_no_class_is_refused(classes: torch.Tensor, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        OneHotLinear(NUM_CLASSES, 5)(classes)
    assert OneHotLinear(NUM_CLASSES, 5)(torch.tensor([[-1, 1], [2, -1]])).shape == (2, 5)


def test_inputs_that_are_no_integers_are_named() -> None:
    network = DistinctWindowNetwork((3, 2), OneHotLinear((3, 2), 5), in_keys=["place", "kind"])
    given = TensorDict(place=torch.tensor([1]), kind=torch.tensor([0.0]), batch_size=[1])
    with pytest.raises(ValueError, match=r"entry 'kind' must hold integers, got torch\.float32"):
        network(given)


def test_tables_add_their_rows_where_no_blank_is_seen() -> None:
    torch.manual_seed(0)
    blank, moves, characters = 3, 4, 3
    network = TupleTables([blank + 1, moves + 1, 3, characters + 1], window=3, hidden_size=8)
    for table in (network.characters, network.moves):
        torch.nn.init.normal_(table)
    sizes = torch.tensor([blank + 1, moves + 1, 3, characters])
    seen = (torch.rand(200, 3, 4) * (sizes + 1)).long() - 1
    seen[:, 0].clamp_(min=0)  # the present step is always there
    logits = network(seen)
    for row, own in zip(seen.tolist(), logits, strict=True):
        expected = network.readout(network.hidden(torch.tensor([row[0]])).relu())[0]
        observations = [step[0] for step in row]
        written = next((character + 1 for _, _, write, character in row if write == 1), 0)
        if blank not in observations:
            place = written
            for observation in observations:
                place = place * (blank + 2) + observation + 1
            added = network.CHARACTER_STEP * network.characters[place]
            expected = torch.cat([expected[: moves + 2], expected[moves + 2 :] + added])
        if observations[0] != blank:
            added = network.MOVE_STEP * network.moves[(row[0][1] + 1) * (moves + 2) + row[1][1] + 1]
            expected = torch.cat([expected[:moves] + added, expected[moves:]])
        assert_close(own, expected)


def test_tables_are_a_policy_without_memory_at_first_and_of_each_case_alone() -> None:
    torch.manual_seed(0)
    policy = make_tuple_policy(4, (4, 2, 3), window=4, tables=True, hidden_size=8)
    network = policy.module[0].network
    seen = torch.zeros(2, 4, 4, dtype=torch.int64)
    seen[1, 3, 0] = 1  # another past, the same present
    before = network(seen)
    assert_close(before[0], before[1], **exactly)
    before[0].sum().backward()
    assert network.characters.grad.abs().sum(-1).count_nonzero() == 1
    assert network.moves.grad.abs().sum(-1).count_nonzero() == 1
    env = AlgorithmicEnv("reversed_addition", num_groups=2, group_size=3, seed=0)
    collector = TrajectoryGroupCollector(env, policy, num_groups=2, group_size=3)
    losses = ECPOLoss(policy)(collector.rollout())
    assert losses["kl_reference_policy"].abs() < 1e-6


def test_tables_need_a_past() -> None:
    with pytest.raises(ValueError, match="window"):
        make_tuple_policy(4, (4, 2, 3), window=1, tables=True)
