from __future__ import annotations

import pickle
from copy import deepcopy
from functools import partial
from itertools import product
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch.nn import functional as F
from torch.testing import assert_close
from torchrl.collectors import Collector
from torchrl.envs import ExplorationType, TransformedEnv, set_exploration_type
from torchrl.modules import (
    LSTMModule,
    ProbabilisticActor,
    get_env_transforms_from_module,
    set_recurrent_mode,
)

from torchrl_ecpo.envs import AlgorithmicEnv
from torchrl_ecpo.modules import DistinctHistoryLSTM, TupleCategorical, make_tuple_policy
from torchrl_ecpo.modules.histories import distinct_histories, hash_histories, hash_states, mix

DTYPES = [torch.float32, torch.float64]
NVEC = (3, 2, 4)
NUM_OBSERVATIONS = 5
ACTIONS = torch.tensor([a for a in product(*map(range, NVEC)) if a[1] or not a[2]])


def random_dist(*batch: int, dtype: torch.dtype = torch.float64) -> TupleCategorical:
    generator = torch.Generator().manual_seed(0)
    logits = torch.randn(*batch, sum(NVEC), dtype=dtype, generator=generator)
    return TupleCategorical(2 * logits, NVEC)


def test_log_prob_is_the_formula() -> None:
    dist = random_dist(6)
    move, write, character = (part.log_softmax(-1) for part in dist.logits.split(NVEC, -1))
    for m, w, c in product(*map(range, NVEC)):
        expected = move[:, m] + write[:, w] + (character[:, c] if w else 0)
        assert_close(dist.log_prob(torch.tensor([m, w, c])), expected)


@pytest.mark.parametrize("dtype", DTYPES)
def test_enumeration(dtype: torch.dtype) -> None:
    dist = random_dist(500, 1, dtype=dtype)
    log_probs = dist.log_prob(ACTIONS)
    assert log_probs.shape == (500, len(ACTIONS))
    assert log_probs.dtype == dtype
    assert_close(log_probs.exp().sum(-1), torch.ones(500, dtype=dtype))
    assert_close(dist.entropy().squeeze(-1), -(log_probs.exp() * log_probs).sum(-1))
    best = ACTIONS[log_probs.argmax(-1)]
    assert_close(dist.mode.squeeze(1), best)
    assert_close(dist.deterministic_sample, dist.mode)
    # Writing competes with its best character: the argmax of each factor would not do.
    write, character = (part.argmax(-1) for part in dist.logits.split(NVEC, -1)[1:])
    independent = torch.cat([write, write * character], -1)
    assert (independent != best[:, 1:]).any(-1).sum() > 10


def test_samples_follow_the_probabilities() -> None:
    torch.manual_seed(0)
    dist = random_dist(2)
    sample = dist.sample((50_000,))
    torch.manual_seed(0)
    action, log_prob = dist.sample_and_log_prob((50_000,))
    assert sample.shape == (50_000, 2, 3)
    assert sample.dtype == torch.int64
    assert_close(action, sample, rtol=0, atol=0)
    assert_close(log_prob, dist.log_prob(sample), rtol=0, atol=0)
    counts = (sample.unsqueeze(-2) == ACTIONS).all(-1).sum(0)
    assert (counts.sum(-1) == 50_000).all()
    expected = 50_000 * dist.log_prob(ACTIONS.unsqueeze(1)).exp().T
    # Five standard deviations of a binomial.
    assert ((counts - expected).abs() <= 5 * expected.sqrt() + 1).all()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_what_is_improbable_is_rare_in_half_precision(dtype: torch.dtype) -> None:
    logits = torch.full((sum(NVEC),), -20.0)
    logits[0] = 0.0
    torch.manual_seed(0)
    moves = TupleCategorical(logits.to(dtype), NVEC).sample((100_000,))[..., 0]
    assert (moves == 0).all()  # the others: 2e-9 each


def in_rows(*shape: int) -> tuple[TupleCategorical, TupleCategorical]:
    """The distribution of rows of a table of logits, and the one of the gathered logits."""
    table = random_dist(5).logits
    rows = torch.randint(5, shape, generator=torch.Generator().manual_seed(1))
    return TupleCategorical(table, NVEC, rows=rows), TupleCategorical(table[rows], NVEC)


def assert_same(ours: TupleCategorical, plain: TupleCategorical) -> None:
    def of(dist: TupleCategorical) -> list[Any]:
        torch.manual_seed(0)
        samples = [dist.sample(), dist.sample((2, 3)), *dist.sample_and_log_prob()]
        every = ACTIONS.view(-1, *[1] * len(dist.batch_shape), 3)
        actions = [every, every.expand(-1, *dist.batch_shape, -1), ACTIONS[4], samples[0]]
        log_probs = [dist.log_prob(action) for action in actions]
        return [dist.batch_shape, dist.logits, dist.mode, dist.entropy(), *samples, *log_probs]

    assert_close(of(ours), of(plain), rtol=0, atol=0)


@pytest.mark.parametrize("shape", [(12,), (3, 4), (), (0,)])
def test_rows_of_logits_are_as_good_as_gathered_logits(shape: tuple[int, ...]) -> None:
    ours, plain = in_rows(*shape)
    assert_same(ours, plain)
    other = torch.tensor([[0, 4], [4, 2]])
    assert ours.logits.shape[:-1] == shape
    assert_same(ours.at(other), TupleCategorical(random_dist(5).logits[other], NVEC))
    assert_same(ours, plain)  # still


def test_places_are_those_of_any_logits_of_the_same_rows() -> None:
    rows, actions = torch.tensor([[0, 2, 2], [4, 0, 2]]), ACTIONS.view(-1, 1, 1, 3)
    table = random_dist(5).logits
    places = TupleCategorical(table, NVEC, rows=rows).places(actions)
    assert len(places.unique()) == 3 * len(ACTIONS)
    other = table.flip(-1).requires_grad_()
    ours = TupleCategorical(other, NVEC).log_prob_at(places)
    plain = TupleCategorical(other[rows], NVEC).log_prob(actions)
    assert_close(ours, plain, rtol=0, atol=0)
    gradients = (torch.autograd.grad(x.sin().sum(), other)[0] for x in (ours, plain))
    assert_close(*gradients)


def test_rows_of_logits_gradients() -> None:
    gradients = []
    rows = torch.tensor([[0, 2, 2], [4, 0, 2]])  # 1 and 3 do not occur
    for gathered in (False, True):
        table = random_dist(5).logits.requires_grad_()
        kwargs: dict[str, Any] = {} if gathered else {"rows": rows}
        dist = TupleCategorical(table[rows] if gathered else table, NVEC, **kwargs)
        objective = dist.log_prob(ACTIONS.view(-1, 1, 1, 3)).sin().sum() + dist.entropy().sum()
        gradients.append(torch.autograd.grad(objective, table)[0])
    assert_close(*gradients)
    assert (gradients[0][[1, 3]] == 0).all()


@pytest.mark.parametrize("dtype", [*DTYPES, torch.float16])
def test_what_is_impossible_is_never_drawn(dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    logits = 3 * torch.randn(400, sum(NVEC), generator=generator).to(dtype)
    impossible = torch.rand(logits.shape, generator=generator) < 0.6
    impossible[:, [1, 3, 6]] = False  # one of each factor remains
    dist = TupleCategorical(logits.masked_fill(impossible, -torch.inf), NVEC)
    double = dtype == torch.float64
    uniform = torch.promote_types(dtype, torch.float32)
    # Also where one number of the distribution function is met exactly.
    points = [0.0, 1 - 2 ** -(53 if double else 24), 0.5]
    extremes = torch.tensor(points, dtype=uniform).view(-1, 1, 1).expand(-1, 400, 3)
    bounds = dist._bounds.movedim(-1, 0)
    choice = dist.choose(
        torch.cat([extremes, bounds[bounds.amax((1, 2)) < 1], bounds.nextafter(-bounds)])
    )
    assert ((choice >= 0) & (choice < torch.tensor(NVEC))).all()
    is_possible = [~part for part in impossible.split(NVEC, -1)]
    for factor, possible in enumerate(is_possible):
        taken = possible.expand(len(choice), -1, -1).gather(-1, choice[..., factor, None])[..., 0]
        assert taken[choice[..., 1] == 1].all() if factor == 2 else taken.all()


@pytest.mark.parametrize("dtype", DTYPES)
def test_extreme_logits(dtype: torch.dtype) -> None:
    size, largest = sum(NVEC), torch.finfo(dtype).max
    logits = torch.tensor([0.0, 1e4, largest, -largest], dtype=dtype)
    logits = logits.repeat(size)[torch.randperm(4 * size)].view(4, size).requires_grad_()
    dist = TupleCategorical(logits, NVEC)
    log_probs = dist.log_prob(ACTIONS.unsqueeze(1))
    values = [dist.entropy(), log_probs.exp().sum(0), dist.log_prob(dist.mode)]
    assert all(value.isfinite().all() for value in values)
    gradient = torch.autograd.grad(sum(v.sum() for v in values), logits)[0]
    assert gradient.isfinite().all()
    assert not log_probs.isnan().any()
    assert ((dist.sample((100,)) >= 0) & (dist.sample((100,)) < torch.tensor(NVEC))).all()


def test_gradients() -> None:
    def both(logits: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        dist = TupleCategorical(logits, NVEC)
        with torch.no_grad():
            dist.entropy()  # must not leave values without a graph
        return dist.log_prob(ACTIONS.unsqueeze(1)), dist.entropy()

    assert torch.autograd.gradcheck(both, random_dist(4).logits.requires_grad_())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"nvec": (3, 3, 4)}, r"nvec: expected \(moves, 2, characters\).* got \(3, 3, 4\)"),
        ({"nvec": (3, 2)}, r"nvec: .* got \(3, 2\)"),
        ({"action": [3, 0, 0]}, r"for nvec=\(3, 2, 4\), got values from \[3, 0, 0\]"),
        ({"action": [0, -1, 0]}, r"got values from \[0, -1, 0\] to \[0, -1, 0\]"),
    ],
)
def test_distribution_refuses(arguments: dict[str, Any], message: str) -> None:
    arguments = {"logits": torch.zeros(2, 9), "nvec": NVEC, "action": [0, 0, 0], **arguments}
    action = torch.tensor(arguments.pop("action"))
    with pytest.raises(ValueError, match=message):
        TupleCategorical(**arguments).log_prob(action)


def test_mix_is_injective_on_what_it_hashes() -> None:
    values = torch.cat([torch.arange(-1000, 50_000), torch.tensor([2**62, -(2**63), 2**63 - 1])])
    assert mix(values).unique().numel() == values.numel()


@pytest.mark.parametrize("hidden", [8, 7])
@pytest.mark.parametrize("dtype", DTYPES)
def test_state_hashes(dtype: torch.dtype, hidden: int) -> None:
    h = torch.randn(200, hidden, dtype=dtype)
    c = torch.randn(200, hidden, dtype=dtype)
    hashes = hash_states(h, c)
    assert hashes.unique().numel() == 200
    assert_close(hash_states(h.flip(0), c.flip(0)), hashes.flip(0))
    # One bit, signs, and which state is which all count.
    assert (hash_states(h.nextafter(h + 1), c) != hashes).all()
    assert (hash_states(-h, c) != hashes).all()
    assert (hash_states(c, h) != hashes).all()
    # A row of a wider tensor is contiguous, wherever it begins.
    packed = torch.cat([torch.zeros(1, 1, dtype=dtype), h[:1]], 1)
    assert_close(hash_states(packed[:, 1:], c[:1]), hashes[:1])


@pytest.mark.parametrize("seed", range(10))
def test_distinct_histories_against_a_dictionary(seed: int) -> None:
    torch.manual_seed(seed)
    steps, rows = 9, 30
    symbols = torch.randint(2, (steps, rows))
    starts = torch.rand(steps, rows) < 0.15
    lengths = torch.randint(1, steps + 1, (rows,))
    mask = torch.arange(steps).unsqueeze(1) < lengths
    first_hashes = torch.randint(2**62, (4,))[torch.randint(4, (rows,))]
    hashes = hash_histories(symbols, starts, num_symbols=2, first_hashes=first_hashes)
    histories = distinct_histories(hashes, starts, mask)

    numbers: dict[Any, int] = {}
    previous: list[Any] = [(first_hashes[n].item(),) for n in range(rows)]
    first = 0
    for t in range(steps):
        current: list[Any] = [None] * rows
        for n in range(rows):
            node = histories.nodes[t, n].item()
            if not mask[t, n]:
                assert node == -1
                continue
            past = () if starts[t, n] else previous[n]
            current[n] = (*past, (t, symbols[t, n].item()))
            assert numbers.setdefault(current[n], node) == node
            place = divmod(histories.rows[node].item(), rows)
            assert place[0] == t
            parent = histories.parents[node].item()
            if starts[t, n]:
                assert parent == -1
            elif t:
                before = histories.nodes[t - 1, n].item()
                assert parent == before - sum(histories.counts[: t - 1])
            else:
                assert first_hashes[parent] == first_hashes[n]
        first += histories.counts[t]
        previous = current
    assert sorted(numbers.values()) == list(range(first))
    assert first == len(histories.parents) == len(histories.rows)


def sequences(kind: str, *batch: int, steps: int) -> TensorDict:
    """Synthetic inputs `[*batch, steps]` whose rows share histories as `kind` says."""
    generator = torch.Generator().manual_seed(0)
    shape = (*batch, steps)
    observation = torch.randint(NUM_OBSERVATIONS, shape, generator=generator)
    action = torch.stack([torch.randint(n + 1, shape, generator=generator) for n in NVEC], -1)
    if kind != "distinct":
        shared = steps if kind == "equal" else steps // 2
        observation[..., :shared] = observation.flatten(0, -2)[0, :shared]
        action[..., :shared, :] = action.flatten(0, -3)[0, :shared]
    is_init = torch.zeros(*shape, 1, dtype=torch.bool)
    is_init[..., 0, :] = True
    data = TensorDict(
        observation=observation, previous_action=action, is_init=is_init, batch_size=shape
    )
    if kind == "restarts":
        flat = data.reshape(-1, steps)
        flat["is_init"][1, steps // 3] = True
        flat["is_init"][2:, 2 * steps // 3] = True
        data = flat.reshape(shape)
    return data


def both_policies(dtype: torch.dtype = torch.float32) -> tuple[Any, Any]:
    """The policy by distinct histories and the one by TorchRL's LSTMModule, with equal weights."""

    torch.manual_seed(0)
    ours = make_tuple_policy(NUM_OBSERVATIONS, NVEC, hidden_size=16).to(dtype)
    sizes = [NUM_OBSERVATIONS, *(n + 1 for n in NVEC)]

    def one_hot(observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        columns = zip((observation, *action.unbind(-1)), sizes, strict=True)
        return torch.cat([F.one_hot(x, n) for x, n in columns], -1).to(dtype)

    lstm = torch.nn.LSTM(sum(sizes), 16, batch_first=True)
    core = TensorDictSequential(
        TensorDictModule(one_hot, ["observation", "previous_action"], ["one_hot"]),
        LSTMModule(lstm=lstm, in_key="one_hot", out_key="embed"),
        TensorDictModule(torch.nn.Linear(16, sum(NVEC)), ["embed"], ["logits"]),
    )
    plain = ProbabilisticActor(
        core,
        in_keys=["logits"],
        distribution_class=TupleCategorical,
        distribution_kwargs={"nvec": NVEC},
        default_interaction_type=ExplorationType.RANDOM,
        return_log_prob=True,
    ).to(dtype)
    for a, b in zip(ours.parameters(), plain.parameters(), strict=True):
        b.data.copy_(a)
    return ours, plain


def logits_and_gradients(policy: Any, data: TensorDict, where: torch.Tensor) -> list[torch.Tensor]:
    with set_recurrent_mode(True):
        logits = policy.get_dist(data.clone()).logits
    weights = torch.randn(
        logits.shape, dtype=logits.dtype, generator=torch.Generator().manual_seed(1)
    )
    objective = torch.where(where.unsqueeze(-1), logits.tanh() * weights, 0).sum()
    gradients = torch.autograd.grad(objective, list(policy.parameters()))
    return [logits[where], *gradients]


def count_rows(policy: Any) -> list[int]:
    """A list that grows by the number of rows of each pass through the readout."""
    rows: list[int] = []
    readout = policy.module[0].readout
    readout.register_forward_hook(lambda module, args, output: rows.append(len(output)))
    return rows


@pytest.mark.parametrize("kind", [None, ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
def test_the_actor_acts_as_its_base_class_does(kind: ExplorationType | None) -> None:
    policy = both_policies()[0]
    step = sequences("shared", 12, steps=3)[:, 0]
    outcomes = []
    with set_exploration_type(kind):
        for act in (policy, partial(ProbabilisticActor.forward, policy)):
            torch.manual_seed(1)
            outcomes.append(act(step.clone()).to_dict())
    assert_close(*outcomes, rtol=0, atol=0)


def test_the_actor_writes_selected_keys_only() -> None:
    policy = both_policies()[0].select_out_keys("action")
    step = sequences("shared", 12, steps=3)[:, 0]
    assert set(policy(step.clone()).keys()) == {*step.keys(), "action"}


KINDS = ["shared", "equal", "distinct", "restarts"]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("kind", "steps"), [*((kind, 9) for kind in KINDS), ("shared", 1)])
def test_update_equals_the_plain_module(kind: str, steps: int, dtype: torch.dtype) -> None:
    data = sequences(kind, 12, steps=steps)
    where = torch.ones(12, steps, dtype=torch.bool)
    policies = both_policies(dtype)
    ours, plain = (logits_and_gradients(policy, data, where) for policy in policies)
    for a, b in zip(ours, plain, strict=True):
        assert_close(a, b)


@pytest.mark.parametrize("kind", KINDS)
def test_padding_costs_nothing(kind: str) -> None:
    data = sequences(kind, 3, 4, steps=9)
    lengths = torch.tensor([9, 8, 5, 1]).expand(3, 4)
    mask = torch.arange(9) < lengths.unsqueeze(-1)
    mask[0, 2] = False  # a trajectory of padding alone, which never begins
    data["is_init"][0, 2] = False
    data["collector", "mask"] = mask
    policy, plain = both_policies()
    ours, theirs = (logits_and_gradients(p, data, mask) for p in (policy, plain))
    for a, b in zip(ours, theirs, strict=True):
        assert_close(a, b)

    rows = count_rows(policy)
    with set_recurrent_mode(True):
        dist = policy.get_dist(data)
    assert (dist.logits[~mask] == 0).all()
    assert dist.entropy().isfinite().all()
    # Four steps are shared, and the second row goes into the fourth with another past.
    apart = int(mask[..., 4:].sum())
    counts = {"equal": 9, "shared": 4 + apart, "restarts": 5 + apart, "distinct": int(mask.sum())}
    assert rows == [counts[kind]]


def step_inputs(data: TensorDict, t: int, before: TensorDict | None) -> TensorDict:
    inputs = data[:, t].clone()
    if before is not None:
        inputs.update(before["next"].select("recurrent_state_h", "recurrent_state_c"))
    return inputs


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", KINDS)
def test_sampling_equals_the_plain_module_and_the_update(kind: str, dtype: torch.dtype) -> None:
    data = sequences(kind, 12, steps=8)
    results = []
    for policy in both_policies(dtype):
        before, logits = None, []
        for t in range(8):
            before = policy(step_inputs(data, t, before))
            logits.append(before["logits"])
        results.append([torch.stack(logits, 1), before["next", "recurrent_state_h"]])
        # Through time, step by step: the states carry gradients.
        results[-1] += torch.autograd.grad(results[-1][0].square().sum(), policy.parameters())
        with set_recurrent_mode(True):
            assert_close(policy.get_dist(data.clone()).logits, results[-1][0])
    for ours, plain in zip(*results, strict=True):
        assert_close(ours, plain)


def test_sampling_survives_reordering_dropping_and_new_weights() -> None:
    data = sequences("restarts", 12, steps=6)
    results = []
    for policy in both_policies():
        current, before, logits = data, None, []
        for t in range(6):
            with torch.no_grad():
                before = policy(step_inputs(current, t, before))
                logits.append(before["logits"])
                for parameter in policy.parameters():
                    parameter.data.mul_(1.1)
            rows = torch.randperm(len(current), generator=torch.Generator().manual_seed(t))[:-1]
            current, before = current[rows], before[rows]
            # The state also travels between processes.
            policy, before = pickle.loads(pickle.dumps((policy, before)))
        results.append(torch.cat(logits))
    assert_close(*results)


def test_sampling_computes_each_history_once() -> None:
    policy, _ = both_policies()
    rows = count_rows(policy)
    data = sequences("shared", 12, steps=8)
    before = None
    for t in range(8):
        inputs = step_inputs(data, t, before)
        inputs["done"] = torch.zeros(12, 1, dtype=torch.bool)
        inputs["done"][4:] = t == 7
        before = policy(inputs)
    assert rows[:4] == [1] * 4
    assert rows[6] == 12
    # Eight rows have ended.
    assert rows[7] == 5


def test_functional_call_and_copies() -> None:
    policy, _ = both_policies()
    data = sequences("shared", 6, steps=5)
    other = deepcopy(policy)
    for parameter in other.parameters():
        parameter.data.mul_(0.5)
    params = TensorDict.from_module(other)
    with set_recurrent_mode(True):
        expected = other.get_dist(data.clone()).logits
        unchanged = policy.get_dist(data.clone()).logits
        with params.to_module(policy, preserve_module_state=False):
            logits = policy.get_dist(data.clone()).logits
        assert_close(logits, expected, rtol=0, atol=0)
        logits.sum().backward()
        assert all(p.grad is not None for p in other.parameters())
        assert all(p.grad is None for p in policy.parameters())
        assert_close(policy.get_dist(data.clone()).logits, unchanged, rtol=0, atol=0)
        assert_close(pickle.loads(pickle.dumps(policy)).get_dist(data.clone()).logits, unchanged)
    assert (expected - unchanged).abs().max() > 1e-3
    assert not list(policy.buffers())


def copy_policy() -> Any:
    torch.manual_seed(0)
    return make_tuple_policy(6, (2, 2, 5), hidden_size=16)


def copy_env(policy: Any = None) -> TransformedEnv:
    """Episodes of a few steps, some of one."""
    env = AlgorithmicEnv("copy", num_groups=4, group_size=2, seed=0)
    return TransformedEnv(env, policy and get_env_transforms_from_module(policy))


def test_rollout() -> None:
    policy = copy_policy()
    data = copy_env(policy).rollout(20, policy, break_when_any_done=False)
    assert data["is_init"][..., 1:, :].any()
    with set_recurrent_mode(True):
        log_prob = policy.get_dist(data).log_prob(data["action"])
    assert_close(log_prob, data["action_log_prob"])
    for key in ("recurrent_state_h", ("next", "recurrent_state_h")):
        assert key not in data.keys(True)


@pytest.mark.parametrize("automatic", [False, True])
def test_collector(automatic: bool) -> None:
    policy = copy_policy()
    collector = Collector(
        copy_env(None if automatic else policy),
        policy,
        frames_per_batch=40,
        total_frames=160,
        trajs_per_batch=5,
        traj_format="padded",
        auto_register_policy_transforms=automatic,
    )
    for data in collector:
        mask = data["collector", "mask"]
        with set_recurrent_mode(True):
            log_prob = policy.get_dist(data.exclude("logits")).log_prob(data["action"])
        assert_close(log_prob[mask], data["action_log_prob"][mask])
    collector.shutdown()


def test_fragments_of_trajectories_are_refused() -> None:
    data = sequences("shared", 12, steps=6)[:, 2:]
    with set_recurrent_mode(True), pytest.raises(ValueError, match="states are not stored"):
        both_policies()[0].module[0](data)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"is_init": None}, KeyError, r"is_init: expected .* append torchrl.envs.InitTracker"),
        ({"is_init": False}, KeyError, r"expected the states .* make_tensordict_primer\(\)"),
        (
            {"observation": 5},
            ValueError,
            r"\[0, n\) for n in \(5, 4, 3, 5\), got values from \[5, ",
        ),
        ({"observation": -1}, ValueError, r"got values from \[-1, "),
        ({"previous_action": 3}, ValueError, r"observation.*got values from .*, 3, "),
    ],
)
def test_core_refuses(change: dict[str, Any], error: type[Exception], message: str) -> None:
    data = sequences("distinct", 4, steps=1)[:, 0].clone()
    for key, value in change.items():
        if value is None:
            del data[key]
        else:
            data[key][:] = value
    with pytest.raises(error, match=message):
        both_policies()[0].module[0](data)


def test_core_refuses_shapes() -> None:
    lstm = DistinctHistoryLSTM([5, 4], 8, in_keys=["observation", "previous_action"])
    data = sequences("distinct", 4, steps=1)[:, 0]
    with pytest.raises(ValueError, match=r"expected 2 integers in all.* got 4"):
        lstm(data)
    with set_recurrent_mode(True), pytest.raises(ValueError, match="time last, in recurrent mode"):
        make_tuple_policy(NUM_OBSERVATIONS, NVEC, hidden_size=8).module[0](data[0])
    with pytest.raises(ValueError, match="tables=True needs a window"):
        make_tuple_policy(NUM_OBSERVATIONS, NVEC, tables=True)
    with pytest.raises(ValueError, match=r"product of at most 2\^31, got \(65536, 65536\)"):
        DistinctHistoryLSTM([2**16, 2**16], 8, in_keys=["observation"])
