"""What ``env=`` names: an environment, the policy that acts in it, and what to measure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    CompositeDistribution,
    NormalParamExtractor,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import Tensor, nn
from torch.distributions import Categorical, Independent
from torchrl.data import Bounded, MultiCategorical
from torchrl.envs import (
    Compose,
    DoubleToFloat,
    EnvBase,
    ExplorationType,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    set_exploration_type,
)
from torchrl.modules import (
    MLP,
    LSTMModule,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
    get_env_transforms_from_module,
)

from torchrl_ecpo.collectors import TrajectoryGroupCollector
from torchrl_ecpo.envs import (
    AlgorithmicEnv,
    BanditEnv,
    DeepSeaEnv,
    EpisodeReplay,
    make_grouped_env,
)
from torchrl_ecpo.experiment._tasks import is_plain, open_task, wrap_task
from torchrl_ecpo.experiment._videos import LONGEST_EPISODE
from torchrl_ecpo.modules import (
    PixelEncoder,
    SharedCategorical,
    make_softmax_policy,
    make_tuple_policy,
)

EVALUATION_EPISODES = 100
LONG_LEVEL = 30  # the last one
Metrics = dict[str, float | Tensor]


@dataclass
class Task:
    """What is to be solved, by which policy, and what is measured."""

    env: EnvBase
    """Of batch size ``[num_groups, group_size]``."""
    make_env: Callable[..., EnvBase]
    """Makes another one, with its own ``num_groups``, in a worker process."""
    actor: ProbabilisticTensorDictSequential
    measure: Callable[[TensorDictBase], Metrics]
    """What a batch of groups ``[num_groups, group_size, T]`` tells beside the loss."""
    evaluate: Callable[[TensorDictBase], Metrics]
    """Measures the actor as it stands, or what takes long to measure of the last batch."""
    shown: Sequence[str]
    """Metrics on the progress bar and in the picture."""
    evaluation_env: nn.Module | None = None
    """Its state goes into checkpoints."""
    make_value_network: Callable[[], TensorDictModule] | None = None
    """For a loss that has one: reads what the policy reads, writes ``"state_value"``."""
    least_entropy: float = 0.01
    """In nats a step; with less, a policy does not explore."""


def make_task(config: DictConfig) -> Task:
    """Build the task that ``env=`` names."""
    makers = {
        "algorithmic": make_algorithmic,
        "bandit": make_bandit,
        "deep_sea": make_deep_sea,
        "gym": make_gym,
    }
    return makers[config.env.kind](config)


def make_bandit(config: DictConfig) -> Task:
    """The synthetic bandit; its one-layer policy is known exactly, so nothing need be sampled."""
    make_env = partial(
        BanditEnv,
        num_actions=config.env.num_actions,
        num_features=config.env.num_features,
        exponent=config.env.exponent,
        instance_seed=config.env.instance_seed,
        group_size=config.group_size,
    )
    env = make_env(num_groups=config.num_groups)
    actor = make_softmax_policy(env.features)
    state = TensorDict({"observation": torch.ones(1)})

    @torch.no_grad()
    def measure(groups: TensorDictBase) -> Metrics:
        distribution = actor.get_dist(state.clone())
        assert isinstance(distribution, SharedCategorical)
        return {"expected_reward": env.expected_reward(distribution.probs)}

    shown = ("expected_reward", "entropy", "ESS")
    task = Task(env, make_env, actor, measure, lambda groups: {}, shown)
    task.make_value_network = lambda: ValueOperator(nn.Linear(1, 1))
    return task


def make_deep_sea(config: DictConfig) -> Task:
    """The deep sea of bsuite; the policy is a table of logits, for each cell two."""
    make_env = partial(
        DeepSeaEnv,
        config.env.size,
        instance_seed=config.env.instance_seed,
        group_size=config.group_size,
    )
    table = nn.Embedding(config.env.size**2 + 1, 2)
    nn.init.zeros_(table.weight)  # the uniform policy
    actor = ProbabilisticActor(
        TensorDictModule(table, ["observation"], ["logits"]),
        in_keys=["logits"],
        distribution_class=Categorical,
        return_log_prob=True,
    )
    env = make_env(num_groups=config.num_groups)
    shown = ("return", "pass_at_1", "pass_at_k", "entropy", "ESS")
    task = Task(env, make_env, actor, partial(passes, solved=0.5), lambda groups: {}, shown)
    task.make_value_network = lambda: ValueOperator(nn.Embedding(config.env.size**2 + 1, 1))
    return task


def make_algorithmic(config: DictConfig) -> Task:
    """A task of gym's algorithmic suite, with the policy that ``policy=`` names."""
    make_env = partial(
        AlgorithmicEnv,
        config.env.name,
        group_size=config.group_size,
        curriculum=config.env.curriculum,
    )
    env = make_env(num_groups=config.num_groups)
    action_spec: Any = env.action_spec
    actor = make_tuple_policy(
        num_observations=env.task.base + 1,
        nvec=action_spec.nvec[0, 0].tolist(),
        hidden_size=config.policy.hidden_size,
        window=config.policy.window,
        tables=config.policy.tables,
    )
    evaluation = Evaluation(config.env.name, actor, config.seed + 1_000_000)

    def measure(groups: TensorDictBase) -> Metrics:
        return {
            "level": groups["level"][..., 0].float().mean(),
            "attained": attained(groups),
            "length": groups["collector", "mask"].sum(-1).float().mean(),
        }

    def evaluate(groups: TensorDictBase) -> Metrics:
        return evaluation.measure(round(groups["level"][..., 0].float().mean().item()))

    def make_value_network() -> TensorDictModule:
        size = config.policy.hidden_size
        return ValueOperator(
            nn.Sequential(nn.Embedding(env.task.base + 1, size), nn.ReLU(), nn.Linear(size, 1))
        )

    shown = ("return", "level", "attained", "entropy", "ESS")
    return Task(env, make_env, actor, measure, evaluate, shown, evaluation, make_value_network)


class Evaluation(nn.Module):
    """Plays an algorithmic task beside the training: greedily, and in groups of ten.

    Its state is that of its environments.
    """

    def __init__(self, name: str, actor: ProbabilisticTensorDictSequential, seed: int) -> None:
        super().__init__()
        half, ten = EVALUATION_EPISODES, 10
        # A level for each row.
        self.greedy = AlgorithmicEnv(name, num_groups=2 * half, curriculum="group")
        self.groups = AlgorithmicEnv(name, num_groups=half // ten, group_size=ten, curriculum=None)
        self._env = [TransformedEnv(self.greedy, get_env_transforms_from_module(actor))]
        self._actor = [actor]  # whose parameters are not the evaluation's
        self._collector = [
            TrajectoryGroupCollector(self.groups, actor, num_groups=half // ten, group_size=ten)
        ]
        for env in (self.greedy, self.groups):
            env.set_seed(seed)

    def measure(self, level: int) -> Metrics:
        """What the policy as it stands is worth at a level of the curriculum.

        ``long_attained`` is that of greedy play at the highest level, which tells early whether a
        policy reads the tape or writes from memory.
        """
        for env in (self.greedy, self.groups):
            env.curriculum.levels.fill_(level)
            env.curriculum.streaks.zero_()
        self.greedy.curriculum.levels[EVALUATION_EPISODES:] = LONG_LEVEL
        played: Any = greedy(self._env[0], self._actor[0])
        episodes, long = played[:EVALUATION_EPISODES], played[EVALUATION_EPISODES:]
        collector = self._collector[0]
        collector.update_policy_weights_()
        groups = collector.rollout()
        solved = is_solved(groups)
        return {
            "greedy_return": _returns(episodes).mean(),
            "greedy_attained": attained(episodes),
            "long_attained": attained(long),
            "pass_at_1": solved.float().mean(),
            "pass_at_10": solved.any(1).float().mean(),
            "distinct_solutions": distinct_solutions(groups),
        }


def make_gym(config: DictConfig) -> Task:
    """A gymnasium task of any readable spaces; its policy is feed-forward but for policy=."""
    name, limited, memory = config.env.name, partial(_limited, config), config.get("policy")
    window = _window(memory)
    units = memory.hidden_size if memory is not None and memory.window is None else 0

    def make_evaluation_copy() -> EnvBase:
        return TransformedEnv(wrap_task(name, window), EpisodeReplay())

    # By its id a task is played by its own vector entry point, if that can be.
    is_as_it_is = window == 1 and is_plain(name)
    source: Any = name if is_as_it_is else partial(open_task, name, window)

    def make_env(num_groups: int) -> EnvBase:
        sizes = {"num_groups": num_groups, "group_size": config.group_size}
        return limited(make_grouped_env(source, **sizes))

    copies = SerialEnv(10, make_evaluation_copy)
    env, evaluation_env = make_env(config.num_groups), limited(copies)
    evaluation_env.set_seed(config.seed + 1_000_000)
    actor = make_gym_policy(env, config.hidden_sizes, units)
    if units:
        transforms = get_env_transforms_from_module(actor)
        evaluation_env = TransformedEnv(evaluation_env, transforms, auto_unwrap=False)

    def measure(groups: TensorDictBase) -> Metrics:
        length = groups["collector", "mask"].sum(-1).float().mean()
        solved = config.env.solved
        passed = {} if solved is None else passes(groups, solved, env.action_keys)
        return {"length": length} | passed

    def evaluate(groups: TensorDictBase) -> Metrics:
        return {"greedy_return": _returns(greedy(evaluation_env, actor)).mean()}

    shown = ("return", "greedy_return", "entropy", "ESS")
    return Task(
        env,
        make_env,
        actor,
        measure,
        evaluate,
        shown,
        copies,
        lambda: ValueOperator(feed_forward(env, 1, config.hidden_sizes)),
        least_entropy(env),
    )


def make_single(config: DictConfig, **pixels: Any) -> EnvBase:
    """A gymnasium task of no batch size, to look at."""
    window = _window(config.get("policy"))
    return _limited(config, wrap_task(config.env.name, window, **pixels))


def _window(memory: DictConfig | None) -> int:
    """How many observations a policy is shown at once."""
    return 1 if memory is None else memory.window or 1


def _limited(config: DictConfig, env: EnvBase) -> EnvBase:
    transforms: list[Any] = [DoubleToFloat(), StepCounter(config.env.max_steps)]
    return TransformedEnv(env, Compose(*transforms))


def least_entropy(env: EnvBase) -> float:
    """0.01 nats for choices; for numbers, that of a uniform one within e^-5 of its range."""
    least = 0.01
    for spec in env.full_action_spec_unbatched.values(True, True):
        if isinstance(spec, Bounded):
            space: Any = spec.space
            least += float(((space.high - space.low).log() - 5).sum())
    return least


class Choices(Independent):
    """Several choices ``[*B, n]``, independent of each other, of ``nvec`` possibilities each."""

    def __init__(self, logits: Tensor, nvec: Sequence[int]) -> None:
        rows = [
            nn.functional.pad(x, (0, max(nvec) - x.shape[-1]), value=-torch.inf)
            for x in logits.split(list(nvec), -1)
        ]
        super().__init__(Categorical(logits=torch.stack(rows, -2)), 1)


class Head(NamedTuple):
    """How an action is drawn from the outputs of a network."""

    size: int
    """Number of these outputs."""
    names: Sequence[str]
    """Of the distribution's parameters."""
    split: nn.Module
    """From the outputs to the parameters."""
    distribution: type
    options: dict[str, Any]

    @classmethod
    def of(cls, spec: Any, one: tuple[int, ...]) -> Head:
        """Categorical for a choice or several, tanh-Gaussian for bounded numbers."""
        space = spec.space
        if isinstance(spec, Bounded):
            bounds = {"low": space.low[one], "high": space.high[one]}
            size = 2 * spec.shape[-1]
            return cls(size, ["loc", "scale"], NormalParamExtractor(), TanhNormal, bounds)
        if spec.ndim == len(one):
            return cls(space.n, ["logits"], nn.Identity(), Categorical, {})
        if isinstance(spec, MultiCategorical):
            first: Any = spec[one]  # pyright: ignore[reportArgumentType] - it takes a tuple
            nvec = first.nvec.tolist()
        else:
            nvec = [space.n] * spec.shape[-1]
        return cls(sum(nvec), ["logits"], nn.Identity(), Choices, {"nvec": nvec})


class Split(nn.Module):
    """The outputs of a network as the parameters of each head, one head after the other."""

    def __init__(self, heads: Sequence[Head]) -> None:
        super().__init__()
        self.sizes = [head.size for head in heads]
        self.splits = nn.ModuleList(head.split for head in heads)

    def forward(self, outputs: Tensor) -> tuple[Tensor, ...]:
        """From ``[..., n]``."""
        of_heads = zip(self.splits, outputs.split(self.sizes, -1), strict=True)
        parts = (split(own) for split, own in of_heads)
        return tuple(p for own in parts for p in (own if isinstance(own, tuple) else (own,)))


def feed_forward(
    env: EnvBase, out_features: int, hidden_sizes: Sequence[int], in_features: int = 0
) -> nn.Module:
    """A multi-layer perceptron on the observation, behind convolutions where it is an image.

    Or, with `in_features`, on so many numbers that stand for it.
    """
    shape = (in_features,) if in_features else env.observation_spec["observation"].shape[env.ndim :]
    encoder = PixelEncoder(shape) if len(shape) == 3 else None
    network = MLP(
        in_features=shape[-1] if encoder is None else encoder.size,
        out_features=out_features,
        num_cells=list(hidden_sizes),
        activation_class=nn.Tanh,
    )
    return network if encoder is None else nn.Sequential(encoder, network)


def make_gym_policy(
    env: EnvBase, hidden_sizes: Sequence[int], units: int = 0
) -> ProbabilisticTensorDictSequential:
    """A network with a head for the actions: categorical or tanh-Gaussian, or one of each.

    With `units`, an LSTM reads the observations, and the network, its state.
    """
    one = (0,) * env.ndim
    specs: Any = env.full_action_spec.items(True, True)
    heads: dict[Any, Head] = {key: Head.of(spec, one) for key, spec in specs}
    size = sum(head.size for head in heads.values())
    network = feed_forward(env, size, hidden_sizes, units)
    names: list[Any]
    if list(heads) == ["action"]:
        head = heads["action"]
        names = in_keys = list(head.names)
        distribution, options = head.distribution, head.options
    else:
        names = [("params", *key, name) for key, head in heads.items() for name in head.names]
        in_keys, distribution = ["params"], CompositeDistribution
        options = {
            "distribution_map": {key: head.distribution for key, head in heads.items()},
            "extra_kwargs": {key: head.options for key, head in heads.items()},
        }

    core: list[Any] = [TensorDictModule(network, ["observation"], ["parameters"])]
    if units:
        size = env.observation_spec["observation"].shape[-1]
        lstm = LSTMModule(size, units, in_key="observation", out_key="embed")
        core = [lstm, TensorDictModule(network, ["embed"], ["parameters"])]
    parts: list[Any] = [
        *core,
        TensorDictModule(Split(list(heads.values())), ["parameters"], names),
    ]
    return ProbabilisticActor(
        TensorDictSequential(*parts),
        in_keys=in_keys,
        out_keys=list(heads),
        distribution_class=distribution,
        distribution_kwargs=options,
        return_log_prob=True,
    )


@torch.no_grad()
def greedy(env: EnvBase, actor: ProbabilisticTensorDictSequential) -> TensorDictBase:
    """One whole episode in each row, with the most probable actions."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return env.rollout(
            LONGEST_EPISODE, actor, break_when_any_done=False, break_when_all_done=True
        )


def passes(
    groups: TensorDictBase, solved: float, action_keys: Sequence[Any] = ("action",)
) -> Metrics:
    """What groups attain, where an episode that earns so much is solved.

    The share of these, that of groups with one, and how many different ones a group has.
    """
    # Rewards that add up to it may fall short by rounding.
    is_high = _returns(groups) >= solved - 1e-6 * max(1.0, abs(solved))
    actions = [groups[key].reshape(*groups.shape, -1) for key in action_keys]
    return {
        "pass_at_1": is_high.float().mean(),
        "pass_at_k": is_high.any(1).float().mean(),
        "distinct_solutions": distinct(is_high, torch.cat(actions, -1), groups),
    }


def distinct_solutions(groups: TensorDictBase) -> float:
    """In how many different ways a group solves its algorithmic task, mean over the groups.

    Ways differ in moves, in when something is written, or in what; a character that is not written
    makes no difference.
    """
    action = groups["action"]
    is_written = torch.ones_like(action, dtype=torch.bool)
    is_written[..., 2] = action[..., 1] == 1
    return distinct(is_solved(groups), action.where(is_written, -1), groups)


def distinct(solved: Tensor, action: Tensor, groups: TensorDictBase) -> float:
    """Different action sequences ``[G, K, T, n]`` among the solved ``[G, K]``, a group."""
    is_real = groups["collector", "mask"].unsqueeze(-1)
    ways = action.where(is_real, -1)[solved].flatten(1)
    group = solved.nonzero()[:, :1]
    return len(torch.cat([group, ways], 1).unique(dim=0)) / len(groups)


def is_solved(episodes: TensorDictBase) -> Tensor:
    """Whether each episode earned all that it could."""
    return _returns(episodes) >= episodes["attainable"][..., 0]


def attained(episodes: TensorDictBase) -> Tensor:
    """What share of all that could be earned was."""
    return _returns(episodes).sum() / episodes["attainable"][..., 0].sum()


def _returns(episodes: TensorDictBase) -> Tensor:
    """Return of each episode; after its end an episode repeats its last step, which is left out."""
    done = episodes["next", "done"].squeeze(-1)
    before_end = done.cumsum(-1) - done.long() == 0
    return (episodes["next", "reward"].squeeze(-1) * before_end).sum(-1)
