"""The recurrent tuple policy: each distinct history once, against TorchRL's LSTMModule.

    python benchmarks/recurrent.py --steps 10 35 66

One thread; both policies have the same weights and inputs and take turns. "sample" is a rollout's
worth of policy steps, "update" one forward and backward pass over its log-probabilities; figures
are medians of processor time in milliseconds, which other processes disturb least. The inputs are
synthetic: the rollouts of a group follow one path, which each leaves with probability `--branch` at
every step; "share" is the part of all histories that is distinct.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from common import read_arguments, write_csv
from loop import take_turns
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.envs import ExplorationType
from torchrl.modules import LSTMModule, ProbabilisticActor, set_recurrent_mode

from torchrl_ecpo.modules import TupleCategorical, make_tuple_policy

NVEC = (2, 2, 5)
NUM_OBSERVATIONS = 6
STATES = ("recurrent_state_h", "recurrent_state_c")


def make_plain_policy(
    num_observations: int, nvec: Sequence[int], hidden_size: int
) -> ProbabilisticActor:
    """The policy of `make_tuple_policy` with TorchRL's LSTMModule."""
    sizes = [num_observations, *(n + 1 for n in nvec)]

    def one_hot(observation: Tensor, action: Tensor) -> Tensor:
        columns = zip((observation, *action.unbind(-1)), sizes, strict=True)
        return torch.cat([F.one_hot(x, n) for x, n in columns], -1).float()

    lstm = nn.LSTM(sum(sizes), hidden_size, batch_first=True)
    parts: list[Any] = [
        TensorDictModule(one_hot, ["observation", "previous_action"], ["one_hot"]),
        LSTMModule(lstm=lstm, in_key="one_hot", out_key="embed"),
        TensorDictModule(nn.Linear(hidden_size, sum(nvec)), ["embed"], ["logits"]),
    ]
    return ProbabilisticActor(
        TensorDictSequential(*parts),
        in_keys=["logits"],
        distribution_class=TupleCategorical,
        distribution_kwargs={"nvec": nvec},
        default_interaction_type=ExplorationType.RANDOM,
        return_log_prob=True,
    )


def make_histories(groups: int, rollouts: int, steps: int, branch: float) -> TensorDict:
    """Inputs and actions `[groups * rollouts, steps]` of rollouts that leave their group's path."""
    shape = (groups, rollouts, steps)
    observation = torch.randint(NUM_OBSERVATIONS, shape)
    action = torch.stack([torch.randint(n, shape) for n in NVEC], -1)
    # Groups differ by their tapes, yet all policies begin alike.
    action[:, 0, :] = action[:1, 0, :]
    on_path = (torch.rand(shape) >= branch).cummin(-1).values
    observation = torch.where(on_path, observation[:, :1], observation)
    action = torch.where(on_path.unsqueeze(-1), action[:, :1], action)
    first = torch.tensor(NVEC).expand(groups, rollouts, 1, 3)
    return TensorDict(
        observation=observation,
        previous_action=torch.cat([first, action[..., :-1, :]], 2),
        action=action,
        is_init=(torch.arange(steps) == 0).expand(shape).unsqueeze(-1),
        batch_size=shape,
    ).reshape(-1, steps)


def sample(policy: ProbabilisticActor, data: TensorDict) -> int:
    """Step through the data as a collector does; how many steps."""
    states = TensorDict(batch_size=data.shape[:1])
    with torch.no_grad():
        for inputs in data.unbind(1):
            states = policy(inputs.copy().update(states))["next"].select(*STATES)
    return data.numel()


def update(policy: ProbabilisticActor, data: TensorDict) -> int:
    """One forward and backward pass; over how many steps."""
    with set_recurrent_mode(True):
        dist = policy.get_dist(data.copy())
    dist.log_prob(data["action"]).sum().backward()
    return data.numel()


def count_distinct(data: TensorDict) -> int:
    """The number of distinct histories."""
    inputs = torch.cat([data["observation"].unsqueeze(-1), data["previous_action"]], -1)
    steps = range(1, data.shape[1] + 1)
    return sum(len(inputs[:, :t].flatten(1).unique(dim=0)) for t in steps)


def main() -> None:
    arguments = read_arguments(
        __doc__,
        steps=[10, 35, 66],
        branch=[0.01, 0.05, 0.2],
        groups=40,
        rollouts=10,
        hidden_size=128,
        repeats=5,
    )
    torch.manual_seed(0)
    policies = [
        make(NUM_OBSERVATIONS, NVEC, hidden_size=arguments.hidden_size)
        for make in (make_plain_policy, make_tuple_policy)
    ]
    for plain, distinct in zip(*(policy.parameters() for policy in policies), strict=True):
        distinct.data.copy_(plain)

    rows = arguments.groups * arguments.rollouts
    print(f"{rows} rows, hidden size {arguments.hidden_size}; plain / distinct, ms")
    print("steps  branch  share |       sample        ratio |       update        ratio | both")
    table = []
    for steps in arguments.steps:
        for branch in arguments.branch:
            data = make_histories(arguments.groups, arguments.rollouts, steps, branch)
            share = count_distinct(data) / data.numel()
            sampling, updating = (
                take_turns([partial(run, one, data) for one in policies], arguments.repeats)[0]
                for run in (sample, update)
            )
            cells = [f"{steps:5d}  {branch:6.2f}  {share:5.2f}"]
            for plain, distinct in (sampling, updating):
                cells.append(f"{plain:8.1f} / {distinct:6.1f}  {plain / distinct:5.1f}x")
            both = (sampling[0] + updating[0]) / (sampling[1] + updating[1])
            print(" | ".join([*cells, f"{both:.1f}x"]), flush=True)
            row = {"steps": steps, "branch": branch, "share": share}
            for name, times in (("sample", sampling), ("update", updating)):
                row |= {f"{name}_plain_ms": times[0], f"{name}_distinct_ms": times[1]}
                row |= {f"{name}_ratio": times[0] / times[1]}
            table.append(row | {"both_ratio": both})
    write_csv(arguments.csv, table)


if __name__ == "__main__":
    main()
