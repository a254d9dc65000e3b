"""What ``ecac.py`` is built from: environments, networks, losses, and how they are measured."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import torch
from crossq import make_renormalised_critic
from omegaconf import DictConfig
from score_sac import ScoreSACLoss
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import Bounded, Categorical, LazyMemmapStorage, LazyTensorStorage, ReplayBuffer
from torchrl.envs import (
    CatTensors,
    Compose,
    DMControlEnv,
    DoubleToFloat,
    EnvBase,
    RewardSum,
    StepCounter,
    TransformedEnv,
)
from torchrl.modules import AdditiveGaussianModule
from torchrl.objectives import (
    CrossQLoss,
    DDPGLoss,
    DiscreteSACLoss,
    LossModule,
    TargetNetUpdater,
    TD3Loss,
    TQCLoss,
)
from width_sac import WidthSACLoss

from torchrl_ecpo import (
    DiscreteECACLoss,
    DiscretePMDACLoss,
    ECACLoss,
    MPOLoss,
    PeriodicCopy,
    PMDACLoss,
    PolyakAverage,
    TemperatureScheduler,
    UpdaterSequence,
)
from torchrl_ecpo._torchrl import carrier_of, generator_of, set_carrier
from torchrl_ecpo.collectors import SupervisedAsyncCollector, SupervisedSyncCollector
from torchrl_ecpo.collectors.workers import spawn_seeds
from torchrl_ecpo.envs import EpisodeReplay
from torchrl_ecpo.experiment import compile_module
from torchrl_ecpo.experiment._tasks import missing, wrap_task
from torchrl_ecpo.experiment._videos import greedy_episodes, save_gif, with_pixels
from torchrl_ecpo.experiment.options import parse
from torchrl_ecpo.modules import (
    make_action_value_network,
    make_categorical_actor,
    make_deterministic_actor,
    make_qvalue_network,
    make_tanh_gaussian_actor,
    make_value_network,
)
from torchrl_ecpo.schedules import make_schedule

LOSSES = {
    "ecac": ECACLoss,
    "discrete_ecac": DiscreteECACLoss,
    "pmd_ac": PMDACLoss,
    "discrete_pmd_ac": DiscretePMDACLoss,
    "discrete_sac": partial(DiscreteSACLoss, action_space="categorical"),
    "mpo": MPOLoss,
    "sac": WidthSACLoss,
    "sac_score": ScoreSACLoss,
    "tqc": TQCLoss,
    "crossq": CrossQLoss,
    "td3": TD3Loss,
    "ddpg": DDPGLoss,
}
ACTORS = {
    "tanh_gaussian": make_tanh_gaussian_actor,
    "tanh_gaussian_small_start": partial(make_tanh_gaussian_actor, final_gain=0.01),
    "deterministic": make_deterministic_actor,
    "categorical": make_categorical_actor,
}
# Entries of loss that are not the loss's own arguments.
OF_THE_SCRIPT = [
    "name",
    "actor",
    "value_network",
    "exploration",
    "policy_delay",
    "reference_interval",
    "num_quantiles",
]
TEMPERATURES = ("tau", "tau_prime")
SHOWN = ("evaluation_return", "return", "entropy", "alpha", "tau", "tau_prime", "steps_per_second")


def check_config(config: DictConfig, options: Sequence[str] = ()) -> None:
    """Refuse options that do not go together."""
    given, env = {own.key_or_group for own in parse(options)}, config.env
    if "env.name" in given and "env.title" not in given and env.name not in env.title:
        raise ValueError(
            f"env.name={env.name}: the runs would be named {env.title} still. Take env=gym, whose "
            "runs are named after the task, or give env.title too."
        )
    _check_actor(config.loss)
    with closing(make_environment(config, seed=config.seed)) as env:
        make_actor(config, env)
        has_pixels = not isinstance(_observation_size(env), int)
    if problems := [*_problems(config.loss, config.critic, has_pixels)]:
        raise ValueError("\n".join(problems))


def _check_actor(loss: DictConfig) -> None:
    kind = "deterministic" if loss.name in ("td3", "ddpg") else "tanh_gaussian"
    kind = "categorical" if loss.name.startswith("discrete_") else kind
    if not loss.actor.startswith(kind):
        raise ValueError(
            f"loss.actor={loss.actor} does not go with loss={loss.name}, whose policy is {kind}: "
            "leave it out."
        )


def _problems(loss: DictConfig, critic: str, has_pixels: bool) -> Iterator[str]:
    if loss.name == "crossq" and critic != "plain":
        yield (
            f"critic={critic} does not go with loss=crossq, whose critics normalise by batches: "
            "leave it out."
        )
    if loss.name in ("crossq", "sac_score") and has_pixels:
        yield f"loss={loss.name} does not read pixels: take loss=sac or another."
    if "alpha_init" in loss and loss.target_entropy is None:
        yield (
            f"loss.target_entropy=null does not go with loss={loss.name}, which learns its "
            "temperature: give a number, in nats, or auto."
        )
    if loss.actor == "categorical" and loss.exploration is not None:
        yield "loss.exploration is noise on numbers, not on one discrete action: leave it out."
    if loss.value_network and loss.name in ("discrete_sac", "tqc", "crossq", "td3", "ddpg"):
        yield f"loss.value_network=true does not go with loss={loss.name}: leave it out."
    if loss.name == "sac_score" and not loss.value_network:
        yield "loss=sac_score needs a value network: leave out loss.value_network=false."


# ------------------------------------------------------------------------------------ environments


def make_environment(config: DictConfig, *, seed: int, **pixels: Any) -> EnvBase:
    """The task that ``env=`` names, with one vector as observation, in single precision.

    Args:
        config: of the run.
        seed: of the episodes.
        pixels: TorchRL's ``from_pixels`` and ``pixels_only``.
    """
    is_gym = config.env.kind == "gym"
    env = wrap_task(config.env.name, **pixels) if is_gym else _make_dm_control(config.env, **pixels)
    transforms: list[Any] = [DoubleToFloat(), RewardSum(), StepCounter(), EpisodeReplay()]
    if not is_gym:
        parts = [key for key in list(env.observation_spec.keys()) if key != "pixels"]
        transforms.insert(0, CatTensors(in_keys=sorted(parts), out_key="observation"))
    env = TransformedEnv(env, Compose(*transforms))
    env.set_seed(seed)
    return env


def make_evaluation_environment(config: DictConfig) -> EnvBase:
    """One of its own, which draws where that is asked for."""
    make = partial(make_environment, config, seed=config.seed + 1_000_000)
    return with_pixels(config.env.title, make) if config.evaluation.video else make()


def _make_dm_control(config: DictConfig, **options: Any) -> EnvBase:
    # dm_control looks for a display as soon as it is imported.
    os.environ.setdefault("MUJOCO_GL", "disabled")
    task = f"env.name={config.name} env.task={config.task}"
    try:
        return DMControlEnv(config.name, config.task, **options)
    except ImportError as error:
        raise missing(task, error) from error
    except RuntimeError as error:
        raise ValueError(f"{task} cannot be made by dm_control: {error}") from error


# ------------------------------------------------------------------------------ networks and losses


def make_actor(config: DictConfig, env: EnvBase) -> TensorDictModuleBase:
    """The policy without exploration."""
    spec: Any = env.action_spec_unbatched
    kind = Categorical if config.loss.actor == "categorical" else Bounded
    if not isinstance(spec, kind) or (kind is Categorical and spec.ndim):
        raise ValueError(
            f"loss={config.loss.name} does not go with env.name={config.env.name}, whose actions "
            f"are {type(spec).__name__}: one discrete action is for loss=discrete_ecac, "
            "discrete_pmd_ac or discrete_sac, a vector of numbers for the others, and any others "
            "for ecpo.py."
        )
    return ACTORS[config.loss.actor](_observation_size(env), spec, hidden_sizes=config.hidden_sizes)


def make_loss(config: DictConfig, actor: TensorDictModuleBase, env: EnvBase) -> LossModule:
    """The loss that ``loss=`` names, with its critics."""
    action_spec: Any = env.action_spec_unbatched
    sizes = {"hidden_sizes": config.hidden_sizes, "layer_norm": config.critic == "layer_norm"}
    critics: list[TensorDictModuleBase]
    if isinstance(action_spec, Categorical):
        critics = [make_action_value_network(_observation_size(env), action_spec.n, **sizes)]
    elif config.loss.name == "crossq":
        dimensions = _observation_size(env), action_spec.shape[-1]
        critics = [make_renormalised_critic(*dimensions, config.hidden_sizes)]
    else:
        outputs = {"num_outputs": config.loss.get("num_quantiles", 1)}
        actions = action_spec.shape[-1]
        critics = [make_qvalue_network(_observation_size(env), actions, **sizes, **outputs)]
    if config.loss.value_network:
        critics.append(make_value_network(_observation_size(env), **sizes))
    options = {str(k): value for k, value in config.loss.items() if k not in OF_THE_SCRIPT}
    for name in TEMPERATURES:
        if isinstance(options.get(name), DictConfig):
            options[name] = make_schedule(options[name])(0)
    if options.get("tau_prime") == 0 and "target_entropy" in options:  # no entropy
        options["target_entropy"] = None
    if "reference_interval" in config.loss:
        options["delay_actor"] = config.loss.reference_interval > 1
    if config.loss.name == "td3":
        options["action_spec"] = action_spec
        options["policy_noise"] *= _half_range(action_spec)
        options["noise_clip"] *= _half_range(action_spec)
    if config.loss.name == "discrete_sac":
        options["num_actions"] = action_spec.n
    if config.loss.name in ("sac", "discrete_sac", "sac_score", "td3", "tqc", "crossq"):
        # Faster on a CPU, with the same numbers; but it would be compiled anew at each call.
        options["deactivate_vmap"] = not config.compile
    loss_module = LOSSES[config.loss.name](actor, *critics, **options)
    loss_module.make_value_estimator(gamma=config.gamma)
    return loss_module


def compute_losses(
    loss_module: LossModule, batch: TensorDictBase, with_policy: bool
) -> TensorDictBase:
    """The losses of a batch; without the policy's where an update leaves the policy."""
    if isinstance(loss_module, TD3Loss) and not with_policy:
        return TensorDict(loss_qvalue=loss_module.value_loss(batch)[0])
    if isinstance(loss_module, CrossQLoss) and not with_policy:
        return TensorDict(loss_qvalue=loss_module.qvalue_loss(batch)[0])
    return loss_module(batch)


def updates_due(frames: int, new: int, per_frame: float) -> int:
    """Updates after the last `new` of so many frames; of fractions the remainders add up."""
    before, now = (math.floor(round(count * per_frame, 6)) for count in (frames - new, frames))
    return now - before


def make_temperatures(config: DictConfig, loss_module: LossModule) -> TemperatureScheduler:
    """Schedules of the temperatures that have one, counted in frames."""
    settings = {name: config.get(name) for name in TEMPERATURES}
    schedules = {
        name: make_schedule(setting)
        for name, setting in settings.items()
        if isinstance(setting, DictConfig)
    }
    try:
        return TemperatureScheduler(loss_module, **schedules)
    except AttributeError as error:  # of which scripts would show a traceback
        raise ValueError(f"A temperature with a schedule: {error}") from error


def make_updater(config: DictConfig, loss_module: LossModule) -> TargetNetUpdater | None:
    """Polyak averages; the reference policy of our losses is a copy instead. CrossQ has neither."""
    delayed = [
        name.removeprefix("target_").removesuffix("_params")
        for name, _ in loss_module.named_children()
        if name.startswith("target_")
    ]
    if not delayed:
        return None
    updaters: list[TargetNetUpdater] = []
    if config.loss.get("reference_interval", 1) > 1:
        delayed.remove("actor_network")
        interval = config.loss.reference_interval
        updaters.append(PeriodicCopy(loss_module, "actor_network", interval=interval))
    return UpdaterSequence(PolyakAverage(loss_module, *delayed, weight=config.polyak), *updaters)


def make_optimizer(config: DictConfig, loss_module: LossModule) -> torch.optim.Optimizer:
    """Adam, with a learning rate for each network and learned temperature that there is."""
    learning_rates = config.lr
    networks: dict[str, list[Tensor]] = {}
    for name, parameter in loss_module.named_parameters():
        owner = name.split(".")[0].removesuffix("_params")
        networks.setdefault(owner, []).append(parameter)
    if without := networks.keys() - set(learning_rates):
        raise ValueError(
            f"optim.lr must have a learning rate for each of {sorted(without)}, got "
            f"{sorted(map(str, learning_rates))}."
        )
    groups: dict[float, list[Tensor]] = {}  # by rate: fewer groups are less overhead
    for owner, parameters in networks.items():
        groups.setdefault(learning_rates[owner], []).extend(parameters)
    return torch.optim.Adam(
        [{"params": parameters, "lr": rate} for rate, parameters in groups.items()],
        betas=tuple(config.get("betas", (0.9, 0.999))),
        fused=True,
    )


def make_policy(config: DictConfig, actor: Any, env: EnvBase) -> TensorDictModuleBase:
    """The policy that collects: the actor, with Gaussian noise where it is deterministic."""
    if config.exploration is None:
        return actor
    noise: Any = AdditiveGaussianModule(
        env.action_spec_unbatched,
        sigma_init=1.0,
        sigma_end=1.0,
        std=(config.exploration * _half_range(env.action_spec_unbatched)).tolist(),
    )
    return TensorDictSequential(actor, noise)


def _observation_size(env: EnvBase) -> Any:
    """Length of a vector, or shape of an image."""
    shape = env.observation_spec["observation"].shape
    return shape if len(shape) > 1 else shape[0]


def _half_range(action_spec: Any) -> Tensor:
    return (action_spec.space.high - action_spec.space.low) / 2


# --------------------------------------------------------------------------------------------- data


def make_collector(config: DictConfig, policy: TensorDictModuleBase) -> Any:
    """One collector in this process, or several in processes of their own."""
    options: dict[str, Any] = {
        "frames_per_batch": (batch := config.collector.frames_per_batch),
        "total_frames": -(-config.total_frames // batch) * batch,  # whole batches
        "init_random_frames": config.collector.init_random_frames,
        "auto_register_policy_transforms": False,
    }
    if config.collector.kind == "single":
        env = make_environment(config, seed=config.seed)
        return Collector(env, policy, track_traj_ids=False, **options)
    workers = range(config.collector.num_collectors)
    makers = [partial(_make_worker_environment, config, worker) for worker in workers]
    make = {"multi_sync": SupervisedSyncCollector, "multi_async": SupervisedAsyncCollector}
    return make[config.collector.kind](makers, policy, **options)


def _make_worker_environment(config: DictConfig, worker: int) -> EnvBase:
    seed = spawn_seeds(config.seed, worker + 1)[worker]
    torch.manual_seed(seed)  # a worker has a generator of its own, which draws its actions
    return make_environment(config, seed=seed)


def make_replay_buffer(config: DictConfig) -> ReplayBuffer:
    """Uniform samples of all transitions, from a generator of its own."""
    size = config.replay_buffer.size
    in_memory = config.replay_buffer.storage == "tensor"
    return ReplayBuffer(
        storage=(
            LazyTensorStorage(size)
            if in_memory
            # Those of a run that is gone on from, or begun anew in its directory, are there.
            else LazyMemmapStorage(size, scratch_dir="replay_buffer", existsok=True)
        ),
        batch_size=config.replay_buffer.batch_size,
        generator=torch.Generator().manual_seed(config.seed),
    )


def compile_parts(config: DictConfig, loss_module: LossModule, actor: TensorDictModuleBase) -> None:
    """Compile what ``compile=true`` asks for: the update, and the policy that acts here."""
    if config.compile:
        compile_module(loss_module, "update")
        if config.collector.kind == "single":
            compile_module(actor, "policy")


class CollectorState:
    """Where a collector stands within its episode; of one with workers, nothing is kept.

    TorchRL's own state dict has the counters and the environment's transforms.
    """

    def __init__(self, collector: Any) -> None:
        self.collector = collector
        self.is_single = isinstance(getattr(collector, "env", None), EnvBase)

    def state_dict(self) -> dict[str, Any]:
        """What TorchRL saves, and what one step hands to the next."""
        if not self.is_single:
            return {}
        return {**self.collector.state_dict(), "carrier": carrier_of(self.collector).to_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Put the simulator where it was, and go on from the step that was handed on."""
        if self.is_single:
            carrier = state_dict["carrier"]
            self.collector.load_state_dict(
                {name: value for name, value in state_dict.items() if name != "carrier"}
            )
            set_carrier(self.collector, carrier_of(self.collector).empty().update(carrier))


class BufferState:
    """The transitions in a replay buffer, without the room for more, and its generator's state."""

    def __init__(self, replay_buffer: ReplayBuffer) -> None:
        self.buffer: Any = replay_buffer
        self.generator: Any = generator_of(replay_buffer.sampler)

    def state_dict(self) -> dict[str, Any]:
        """A copy of the transitions, the place to write next and the generator's state."""
        transitions = self.buffer[:].clone() if len(self.buffer) else TensorDict()
        return {
            "transitions": transitions.to_dict(),
            "writer": self.buffer.writer.state_dict(),
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Fill an empty buffer as it was."""
        if state_dict["transitions"]:
            self.buffer.extend(TensorDict(state_dict["transitions"]).auto_batch_size_(1))
        self.buffer.writer.load_state_dict(state_dict["writer"])
        self.generator.set_state(state_dict["generator"])


# ------------------------------------------------------------------------------------- measurements


def finished_returns(transitions: TensorDictBase) -> list[float]:
    """Returns of the episodes that end in a batch."""
    return transitions["next", "episode_reward"][transitions["next", "done"]].tolist()


def evaluate(
    env: EnvBase, actor: TensorDictModuleBase, config: DictConfig, frames: int
) -> dict[str, float]:
    """Mean return of whole episodes with the deterministic policy; a video of the first."""
    episodes = greedy_episodes(env, actor, config.episodes)
    if config.video:
        save_gif(Path(f"evaluation_{frames}.gif"), episodes[0])
    returns = [episode["next", "episode_reward"][-1].item() for episode in episodes]
    return {"evaluation_return": mean(returns)}


def scalars(losses: TensorDictBase) -> dict[str, float]:
    """The entries of a loss's output that are one number."""
    return {str(name): value.item() for name, value in losses.items() if value.numel() == 1}


def mean(values: Sequence[float]) -> float:
    """The mean; NaN of nothing."""
    return sum(values) / len(values) if values else float("nan")


class Every:
    """Whether a growing count has passed another multiple of an interval since last asked."""

    def __init__(self, interval: int) -> None:
        self.interval = interval
        self.passed = 0

    def __call__(self, count: int) -> bool:
        """Ask at a count."""
        passed, self.passed = self.passed, count // self.interval
        return self.passed > passed

    def state_dict(self) -> dict[str, int]:
        """How many multiples have passed."""
        return {"passed": self.passed}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Continue from there."""
        self.passed = state_dict["passed"]


class Speed:
    """Growth of a count per second since last asked."""

    def __init__(self, count: int) -> None:
        self.count, self.time = count, time.perf_counter()

    def __call__(self, count: int) -> float:
        """Ask at a count."""
        now = time.perf_counter()
        rate = (count - self.count) / (now - self.time)
        self.count, self.time = count, now
        return rate
