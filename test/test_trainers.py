"""The losses in TorchRL's trainers, by hand and by its hydra configs."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException, InstantiationException
from hydra.utils import instantiate
from omegaconf.errors import MissingMandatoryValue
from tensordict import TensorDict
from tensordict.nn import InteractionType, NormalParamExtractor, TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torch.testing import assert_close
from torchrl.collectors import Collector
from torchrl.data import Bounded, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, DoubleToFloat, GymEnv, RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SoftUpdate, group_optimizers
from torchrl.trainers.algorithms import SACTrainer, configs

import torchrl_ecpo
from torchrl_ecpo import ActorCriticLoss, ECACLoss, TrustPCLLoss, trainers
from torchrl_ecpo.modules import make_qvalue_network, make_tanh_gaussian_actor

pytestmark = pytest.mark.usefixtures("torchrl_configs")
ROOT = Path(__file__).parents[1]
LOSSES = [
    getattr(torchrl_ecpo, name)
    for name in torchrl_ecpo.__all__
    if name.endswith("Loss") and not inspect.isabstract(getattr(torchrl_ecpo, name))
]


def networks(loss_class):
    """What its constructor cannot do without."""
    torch.manual_seed(0)
    if issubclass(loss_class, ActorCriticLoss) and "Discrete" not in loss_class.__name__:
        actor = make_tanh_gaussian_actor(3, Bounded(-1.0, 1.0, shape=(2,)))
        return {"actor_network": actor, "qvalue_network": make_qvalue_network(3, 2)}
    network = TensorDictModule(nn.Linear(3, 4), ["observation"], ["logits"])
    made = {
        "actor_network": ProbabilisticActor(network, ["logits"], distribution_class=Categorical)
    }
    if issubclass(loss_class, ActorCriticLoss):
        qvalue = TensorDictModule(nn.Linear(3, 4), ["observation"], ["action_value"])
        made["qvalue_network"] = qvalue
    elif issubclass(loss_class, TrustPCLLoss):
        made["value_network"] = ValueOperator(nn.Linear(3, 1), in_keys=["observation"])
    return made


def settings(loss_module):
    """What its options have been made of."""
    plain = (int, float, str, tuple, dict, type(None))
    kept = {key: value for key, value in vars(loss_module).items() if isinstance(value, plain)}
    kept = {key: value for key, value in kept.items() if not key.startswith("_")}
    return kept, loss_module.state_dict(), loss_module.out_keys


@pytest.mark.parametrize("loss_class", LOSSES, ids=lambda loss_class: loss_class.__name__)
def test_every_loss_has_a_config_with_its_defaults(loss_class):
    config = getattr(trainers, f"{loss_class.__name__}Config")
    assert config.__name__ in trainers.__all__
    known = ConfigStore.instance().repo["loss"].values()
    assert any(node.node._metadata.object_type is config for node in known)
    torch.manual_seed(1)  # draws what is copied
    configured = instantiate(config, **networks(loss_class))
    torch.manual_seed(1)
    made = loss_class(**networks(loss_class))
    assert type(configured) is loss_class
    (kept, state, keys), (own, own_state, own_keys) = settings(configured), settings(made)
    assert (kept, keys) == (own, own_keys)
    assert_close(state, own_state)
    with pytest.raises(MissingMandatoryValue, match="actor_network"):
        instantiate(config)


def test_the_names_are_documented_and_not_torchrls():
    nodes = ConfigStore.instance().repo["loss"].items()
    kinds = {name.removesuffix(".yaml"): node.node._metadata.object_type for name, node in nodes}
    ours = {name for name, kind in kinds.items() if kind.__module__ == trainers.__name__}
    assert len(ours) == len(LOSSES)
    assert {"ecpo", "ecac", "pmd", "discrete_ecac"} < ours
    theirs = re.findall(r'group="loss", name="(\w+)"', inspect.getsource(configs))
    assert "sac" in theirs
    assert not ours.intersection(theirs)
    page = (ROOT / "docs/tutorials/torchrl_trainers.md").read_text()
    assert all(f"`{name}`" in page for name in ours)


@pytest.fixture
def composed(tmp_path):
    """Composes a configuration with one of the losses."""

    def composed(loss, *overrides, text="{}"):
        defaults = f"defaults: [{{loss@loss: {loss}}}, _self_]\nloss: {text}\n"
        (tmp_path / "config.yaml").write_text(defaults)
        with initialize_config_dir(str(tmp_path), version_base="1.3"):
            return compose("config", list(overrides)).loss

    return composed


def test_options_come_from_the_command_line(composed):
    config = composed("ecac", "loss.tau=0.5", "loss.target_entropy=null", text="{gamma: 0.9}")
    loss_module = instantiate(config, **networks(ECACLoss))
    assert_close(loss_module.log_tau.exp(), torch.tensor(0.5))
    assert "loss_tau_prime" not in loss_module.out_keys
    assert_close(loss_module.value_estimator.gamma, torch.tensor(0.9))

    loss_module = instantiate(
        composed("trust_pcl", "loss.gamma=0.5", "loss.n_steps=3"), **networks(TrustPCLLoss)
    )
    assert (loss_module.gamma, loss_module.n_steps) == (0.5, 3)

    config = composed("grpo", "loss.clip_epsilon=[0.1,0.3]")
    loss_module = instantiate(config, **networks(torchrl_ecpo.GRPOLoss))
    assert (loss_module.clip_low, loss_module.clip_high) == (0.1, 0.3)


def test_a_partial_loss_takes_its_networks_later(composed):
    make = instantiate(composed("ecpo", "loss._partial_=true", "loss.tau=2"))
    assert make(**networks(torchrl_ecpo.ECPOLoss)).tau == 2


def test_unknown_options_are_refused(composed):
    with pytest.raises(HydraException, match=r"Could not override 'loss\.alpha_init'"):
        composed("ecac", "loss.alpha_init=1")
    with pytest.raises(HydraException, match="'alpha_init' not in 'ECACLossConfig'"):
        composed("ecac", text="{alpha_init: 1}")
    with pytest.raises(TypeError, match=r"ECACLossConfig.*'alpha_init'"):
        trainers.ECACLossConfig(alpha_init=1)
    with pytest.raises(InstantiationException, match=r"ECPOLoss has no option 'alpha'; it has act"):
        instantiate(trainers.ECPOLossConfig, alpha=1, actor_network=None)
    with pytest.raises(InstantiationException, match="ECPOLoss has no option 'gamma'"):
        instantiate(trainers.ECPOLossConfig, gamma=1, actor_network=None)
    with pytest.raises(InstantiationException, match=r"tau must be .*'hot'"):
        instantiate(trainers.ECPOLossConfig, tau="hot", **networks(torchrl_ecpo.ECPOLoss))


@pytest.mark.parametrize("loss_class", LOSSES, ids=lambda loss_class: loss_class.__name__)
def test_a_loss_refuses_unknown_options_in_its_own_name(loss_class):
    message = (
        rf"^{loss_class.__name__} has no option 'foo', 'tou'; it has actor_network, .*reduction"
    )
    with pytest.raises(TypeError, match=message):
        loss_class(**networks(loss_class), foo=1, reduction="mean", tou=1)


class Optimising:
    """What of a trainer a hook sees."""

    def __init__(self, loss_module, **options):
        self.loss_module = loss_module
        self.optimizer = torch.optim.Adam(loss_module.parameters(), **options)


def test_learning_rates_are_those_that_are_named():
    loss_module = ECACLoss(**networks(ECACLoss))
    trainer = Optimising(loss_module, lr=0.001, eps=0.0)
    instantiate(
        {"_target_": "torchrl_ecpo.trainers.LearningRates", "log_tau": 0.01, "actor_network": 0.1}
    ).register(trainer)
    groups = trainer.optimizer.param_groups
    assert [group["lr"] for group in groups] == [0.001, 0.01, 0.1]
    before = {name: value.clone() for name, value in loss_module.named_parameters()}
    for parameter in loss_module.parameters():
        parameter.grad = torch.ones_like(parameter)
    trainer.optimizer.step()  # Adam's first step has the length of the rate
    for name, value in loss_module.named_parameters():
        rate = {"log_tau": 0.01, "actor_network_params": 0.1}.get(name.split(".")[0], 0.001)
        assert_close(value, before[name] - rate)


def test_a_learning_rate_of_its_own_changes_nothing_else():
    trainer = Optimising(ECACLoss(**networks(ECACLoss)))
    own = {"params": [*trainer.loss_module.parameters()], "eps": 1e-5, "weight_decay": 0.1}
    trainer.optimizer = torch.optim.Adam([own], lr=1e-3)
    trainers.LearningRates(actor_network=1e-2).register(trainer)
    kept = [(one["lr"], one["eps"], one["weight_decay"]) for one in trainer.optimizer.param_groups]
    assert kept == [(1e-3, 1e-5, 0.1), (1e-2, 1e-5, 0.1)]


def test_wrong_learning_rates_are_refused():
    trainer = Optimising(ECACLoss(**networks(ECACLoss)))
    known = "the loss learns actor_network, log_tau, log_tau_prime, qvalue_network"
    with pytest.raises(ValueError, match=f"names log_alpha; {known}"):
        trainers.LearningRates(log_alpha=0.1).register(trainer)
    with pytest.raises(ValueError, match="log_tau must be a number, got 'fast'"):
        trainers.LearningRates(log_tau="fast")
    for rate in (-1, float("inf"), float("nan")):
        with pytest.raises(ValueError, match=rf"log_tau must be in \[0, inf\), got {rate}"):
            trainers.LearningRates(log_tau=rate)
    trainer.optimizer = torch.optim.Adam([*trainer.loss_module.actor_network_params.parameters()])
    with pytest.raises(ValueError, match="names log_tau, which the trainer's optimizer does not"):
        trainers.LearningRates(log_tau=0.1).register(trainer)
    torch.optim.lr_scheduler.LambdaLR(trainer.optimizer, lambda step: 1.0)
    with pytest.raises(ValueError, match="register LearningRates before it is made"):
        trainers.LearningRates(log_tau=0.1).register(trainer)
    trainer.optimizer = None
    with pytest.raises(ValueError, match="needs a trainer with an optimizer="):
        trainers.LearningRates(log_tau=0.1).register(trainer)


@pytest.mark.filterwarnings("ignore:SACTrainer is an experimental", "ignore:.*OptimizationStepper")
def test_sac_trainer_trains_ecac():
    torch.manual_seed(0)
    transforms = Compose(DoubleToFloat(), RewardSum(["reward"], ["reward_sum"]))
    env = TransformedEnv(GymEnv("Pendulum-v1"), transforms)
    actor, qvalue = make_tanh_gaussian_actor(3, env.action_spec), make_qvalue_network(3, 1)
    loss_module = ECACLoss(actor, qvalue)
    collector = Collector(
        env, actor, frames_per_batch=20, total_frames=40, auto_register_policy_transforms=False
    )
    trainer = SACTrainer(
        collector=collector, total_frames=40, frame_skip=1, optim_steps_per_batch=2,
        loss_module=loss_module, optimizer=torch.optim.Adam(loss_module.parameters(), lr=0.01),
        replay_buffer=TensorDictReplayBuffer(storage=LazyTensorStorage(100), batch_size=16),
        target_net_updater=SoftUpdate(loss_module, tau=0.1), progress_bar=False,
    )  # fmt: skip
    before = {name: value.clone() for name, value in loss_module.state_dict().items()}
    trainers.LearningRates(log_tau=0.1).register(trainer)
    trainer.train()
    after = loss_module.state_dict()
    for part in ("actor_network_params", "qvalue_network_params", "target_qvalue", "log_tau"):
        assert any((after[key] != before[key]).any() for key in before if key.startswith(part))


def test_the_networks_and_optimisers_of_torchrls_sac_script():
    torch.manual_seed(0)
    spec = Bounded(-2.0, 2.0, shape=(1,))
    layers = nn.Sequential(nn.Linear(3, 2), NormalParamExtractor("biased_softplus_1.0"))
    actor = ProbabilisticActor(
        TensorDictModule(layers, ["observation"], ["loc", "scale"]), ["loc", "scale"], spec=spec,
        distribution_class=TanhNormal, return_log_prob=False,
        distribution_kwargs={"low": -2.0, "high": 2.0, "tanh_loc": False},
        default_interaction_type=InteractionType.RANDOM,
    )  # fmt: skip
    qvalue = ValueOperator(MLP(4, 1, num_cells=[8]), in_keys=["action", "observation"])
    loss_module = ECACLoss(actor, qvalue, num_qvalue_nets=2, loss_function="smooth_l1")
    loss_module.make_value_estimator(gamma=0.99)
    updater = SoftUpdate(loss_module, eps=0.995)
    optimizer = group_optimizers(
        torch.optim.Adam(loss_module.actor_network_params.flatten_keys().values(), lr=3e-4),
        torch.optim.Adam(loss_module.qvalue_network_params.flatten_keys().values(), lr=3e-4),
        torch.optim.Adam([loss_module.log_tau], lr=1e-2),
        torch.optim.Adam([loss_module.log_tau_prime], lr=3e-4),
    )
    before = {name: value.detach().clone() for name, value in loss_module.named_parameters()}
    observation = {"observation": torch.randn(6, 3)}
    flags = {"done": torch.zeros(6, 1, dtype=torch.bool)}
    outcome = flags | {"terminated": flags["done"].clone(), "reward": torch.randn(6, 1)}
    batch = TensorDict(
        {**observation, "action": torch.rand(6, 1), "next": {**observation, **outcome}}, [6]
    )
    losses = loss_module(batch)
    names = ("loss_actor", "loss_qvalue", "loss_tau", "loss_tau_prime")
    sum(losses[name] for name in names).backward()
    optimizer.step()
    updater.step()
    for name, value in loss_module.named_parameters():
        assert (value != before[name]).any(), name
    assert_close(
        (loss_module.log_tau - before["log_tau"]).abs(), torch.tensor(0.01), rtol=1e-3, atol=0
    )
