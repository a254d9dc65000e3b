"""Updaters that follow named networks: PeriodicCopy, PolyakAverage, UpdaterSequence."""

from __future__ import annotations

import io
import re

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.data import Bounded
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import (
    DDPGLoss,
    LossModule,
    SACLoss,
    SoftUpdate,
    TargetNetUpdater,
)

from torchrl_ecpo import ECACLoss
from torchrl_ecpo._torchrl import networks_with_updater
from torchrl_ecpo.checks import values_can_be_seen
from torchrl_ecpo.modules import make_qvalue_network, make_tanh_gaussian_actor
from torchrl_ecpo.updaters import PeriodicCopy, PolyakAverage, UpdaterSequence

OBSERVATIONS, ACTIONS, HIDDEN = 3, 2, 4


class QNetwork(nn.Module):
    """Q(s, a), with buffers: the running statistics and the batch counter of a BatchNorm layer.

    Without ``norm`` there are none: TorchRL's SAC stacks critics and runs them in a vmap.
    """

    def __init__(self, *, norm: bool) -> None:
        super().__init__()
        self.inputs = nn.Linear(OBSERVATIONS + ACTIONS, HIDDEN)
        self.norm = nn.BatchNorm1d(HIDDEN) if norm else nn.Identity()
        self.output = nn.Linear(HIDDEN, 1)

    def forward(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        features = self.inputs(torch.cat([observation, action], -1))
        return self.output(self.norm(features).tanh())


def stochastic_actor() -> ProbabilisticActor:
    net = nn.Sequential(nn.Linear(OBSERVATIONS, 2 * ACTIONS), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
        spec=Bounded(-1, 1, torch.Size([ACTIONS])),
    )


def sac(*, delay_actor: bool = True) -> SACLoss:
    """SAC with two stacked critics: networks actor_network, qvalue_network."""
    critic = ValueOperator(QNetwork(norm=False), in_keys=["observation", "action"])
    return SACLoss(stochastic_actor(), critic, num_qvalue_nets=2, delay_actor=delay_actor)


def ddpg(*, delay_actor: bool = True, delay_value: bool = True) -> DDPGLoss:
    """DDPG, whose critic has buffers: networks actor_network, value_network."""
    net = nn.Sequential(nn.Linear(OBSERVATIONS, HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, ACTIONS))
    actor = TensorDictModule(net, in_keys=["observation"], out_keys=["action"])
    critic = ValueOperator(QNetwork(norm=True), in_keys=["observation", "action"])
    return DDPGLoss(actor, critic, delay_actor=delay_actor, delay_value=delay_value)


every_loss = pytest.mark.parametrize("make_loss", [sac, ddpg])


@pytest.fixture(autouse=True)
def seed() -> None:
    torch.manual_seed(0)


def critic_name(loss: LossModule) -> str:
    return "value_network" if isinstance(loss, DDPGLoss) else "qvalue_network"


def leaves(loss: LossModule, prefix: str) -> dict:
    """The tensors themselves, without TorchRL's warning about targets that have no updater."""
    return dict(dict(loss.named_children())[f"{prefix}_params"].items(True, True))


def snapshot(loss: LossModule, prefix: str) -> dict:
    return {key: leaf.detach().clone() for key, leaf in leaves(loss, prefix).items()}


def is_level(loss: LossModule, name: str) -> bool:
    """Whether the delayed network equals the network."""
    return equal(snapshot(loss, f"target_{name}"), snapshot(loss, name))


def equal(left: dict, right: dict) -> bool:
    assert left.keys() == right.keys()
    return all(torch.equal(left[key], right[key]) for key in left)


def train(loss: LossModule) -> None:
    """Changes every parameter and buffer of every network, as some gradient steps would."""
    for name in networks_with_updater(loss):
        for leaf in leaves(loss, name).values():
            leaf.data.add_((1 + torch.rand(leaf.shape)).to(leaf.dtype))


def batch() -> TensorDict:
    never = torch.zeros(6, 1, dtype=torch.bool)
    following = {"observation": torch.randn(6, OBSERVATIONS), "reward": torch.randn(6, 1)}
    following |= {"done": never, "terminated": never}
    now = {"observation": torch.randn(6, OBSERVATIONS), "action": torch.rand(6, ACTIONS)}
    return TensorDict(now | {"next": following}, [6])


class TestPeriodicCopy:
    @pytest.mark.parametrize("compiled", [False, True])
    @pytest.mark.parametrize("interval", [1, 3])
    def test_copies_on_exactly_every_nth_call(self, interval, compiled):
        loss = ddpg()
        step = PeriodicCopy(loss, "actor_network", interval=interval).step
        if compiled:
            step = torch.compile(step, backend="eager", fullgraph=True)
        before = snapshot(loss, "target_actor_network")
        copies = []
        for call in range(1, 11):
            train(loss)
            step()
            after = snapshot(loss, "target_actor_network")
            if is_level(loss, "actor_network"):
                copies.append(call)
            else:
                assert equal(after, before)
            before = after
        assert copies == list(range(interval, 11, interval))

    def test_a_graph_of_cuda_would_not_count(self, monkeypatch):
        monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
        monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: True)
        assert not values_can_be_seen()
        PeriodicCopy(sac(), "actor_network", interval=1).step()
        with pytest.raises(RuntimeError, match=r"call step\(\) outside of the graph"):
            PeriodicCopy(sac(), "actor_network", interval=2).step()

    def test_init_and_a_saved_state_set_the_count(self):
        loss = ddpg()
        updater = PeriodicCopy(loss, "actor_network", interval=2)
        updater.step()
        updater.init_()
        train(loss)
        updater.step()
        assert not is_level(loss, "actor_network")
        # Saved with a longer interval: the next call copies.
        updater.load_state_dict({"initialized": True, "counter": 7})
        updater.step()
        assert is_level(loss, "actor_network")
        assert updater.counter == 0


class TestPolyakAverage:
    @pytest.mark.parametrize("weight", [0.005, 0.25, 1.0])
    @every_loss
    def test_is_the_exponential_average(self, make_loss, weight):
        """Of buffers and frozen layers too; integers are copied."""
        loss = make_loss()
        name = critic_name(loss)
        leaves(loss, name)["module", "output", "weight"].requires_grad_(False)
        updater = PolyakAverage(loss, name, weight=weight)
        expected = snapshot(loss, f"target_{name}")
        for _ in range(4):
            train(loss)
            updater.step()
            for key, source in snapshot(loss, name).items():
                if source.is_floating_point():
                    expected[key] = (1 - weight) * expected[key] + weight * source
                else:
                    expected[key] = source
        torch.testing.assert_close(snapshot(loss, f"target_{name}"), expected)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_averages_in_half_precision_arrive_also_when_resumed(dtype):
    """As in single precision but for the last rounding; what others write is where they go on."""
    loss = sac().to(dtype)
    updater = PolyakAverage(loss, "qvalue_network")
    expected = {key: leaf.float() for key, leaf in snapshot(loss, "qvalue_network").items()}
    train(loss)
    sources = {key: leaf.float() for key, leaf in snapshot(loss, "qvalue_network").items()}
    for call in range(400):
        updater.step()
        expected = {key: leaf.lerp(sources[key], 0.005) for key, leaf in expected.items()}
        if call == 200:
            file, values = io.BytesIO(), {k: v.clone() for k, v in loss.state_dict().items()}
            torch.save(updater.state_dict(), file)
            file.seek(0)
            saved = torch.load(file, weights_only=True)
            updater.init_()
            updater.load_state_dict(saved)
            loss.load_state_dict(values)
            for average in (
                *saved["averages"].values(),
                *updater.state_dict()["averages"].values(),
            ):
                average.zero_()  # neither is live
    averaged = snapshot(loss, "target_qvalue_network")
    assert equal(averaged, {key: leaf.to(dtype) for key, leaf in expected.items()})
    leaves(loss, "target_qvalue_network")["module", "output", "bias"].fill_(7)
    averages = updater.state_dict()["averages"]
    assert (averages["qvalue_network.module.output.bias"] == 7).all()


def test_averages_in_half_precision_are_named_as_the_parameters():
    actor = make_tanh_gaussian_actor(3, Bounded(-1.0, 1.0, shape=(2,)))
    loss = ECACLoss(actor, make_qvalue_network(3, 2)).to(torch.bfloat16)
    names = {f"qvalue_network.{part}_{i}" for part in ("weight", "bias") for i in range(3)}
    assert {*PolyakAverage(loss, "qvalue_network").state_dict()["averages"]} == names


UPDATERS = {
    "periodic": lambda loss, *networks: PeriodicCopy(loss, *networks, interval=1),
    "polyak": lambda loss, *networks: PolyakAverage(loss, *networks, weight=0.5),
}
every_updater = pytest.mark.parametrize("make_updater", UPDATERS.values(), ids=UPDATERS)


@every_updater
class TestNamedNetworks:
    @every_loss
    def test_touches_its_own_network_only(self, make_updater, make_loss):
        loss = make_loss()
        train(loss)  # every target is now away from its source, so that a stray copy would show
        other = f"target_{critic_name(loss)}"
        before, own = snapshot(loss, other), snapshot(loss, "target_actor_network")
        updater = make_updater(loss, "actor_network")
        train(loss)
        updater.step()
        updater.init_()
        assert not equal(snapshot(loss, "target_actor_network"), own)
        assert equal(snapshot(loss, other), before)

    def test_without_names_follows_all_and_init_makes_them_level(self, make_updater):
        loss = ddpg()
        train(loss)
        updater = make_updater(loss)
        assert updater.networks == ("actor_network", "value_network")
        assert all(is_level(loss, name) for name in updater.networks)
        loss.reset_parameters_recursive()
        assert not is_level(loss, "actor_network")
        updater.init_()  # without a warning
        assert all(is_level(loss, name) for name in updater.networks)

    def test_targets_remain_the_same_buffers(self, make_updater):
        loss = sac()
        trained = {name for name, _ in loss.named_parameters()}
        before = leaves(loss, "target_qvalue_network")
        updater = make_updater(loss, "qvalue_network")
        train(loss)
        updater.step()
        assert trained == {name for name, _ in loss.named_parameters()}
        for key, target in leaves(loss, "target_qvalue_network").items():
            assert target is before[key]
            assert not target.requires_grad

    def test_follows_a_loss_that_was_cast_also_when_compiled(self, make_updater):
        torch._dynamo.reset()  # each test compiles anew, and there is a limit
        loss = sac()
        updater = make_updater(loss, "actor_network")
        step = torch.compile(updater.step, backend="eager", fullgraph=True)
        for dtype in (torch.float64, torch.float32, torch.bfloat16):
            loss.to(dtype)
            train(loss)
            target, source = (snapshot(loss, f"{p}actor_network") for p in ("target_", ""))
            weight = getattr(updater, "weight", 1)  # a copy goes the whole way
            wide = torch.promote_types(dtype, torch.float32)
            target, source = ({k: x.to(wide) for k, x in td.items()} for td in (target, source))
            expected = {key: target[key].lerp(source[key], weight).to(dtype) for key in target}
            step()
            after = snapshot(loss, "target_actor_network")
            assert all(leaf.dtype == dtype for leaf in after.values())
            torch.testing.assert_close(after, expected)


class TestErrors:
    @pytest.mark.parametrize(
        ("make_loss", "networks", "message"),
        [
            (
                sac,
                ("actor",),
                "['actor'] of SACLoss: its delayed networks are "
                "['actor_network', 'qvalue_network']",
            ),
            (
                lambda: ddpg(delay_actor=False, delay_value=False),
                (),
                "a network of DDPGLoss: its delayed networks are []. A network is delayed by an "
                "argument of the loss, such as delay_actor=True",
            ),
            (sac, ("actor_network", "actor_network"), "A network is named twice"),
        ],
    )
    def test_networks(self, make_loss, networks, message):
        with pytest.raises(ValueError, match=re.escape(message)):
            PolyakAverage(make_loss(), *networks)

    @pytest.mark.parametrize("weight", [0, 1.1])
    def test_weights_at_the_edges(self, weight):
        with pytest.raises(ValueError, match=rf"weight must be in \(0, 1\], got {weight}"):
            PolyakAverage(ddpg(), "actor_network", weight=weight)

    def test_targets_that_require_a_gradient(self):
        loss = sac()
        target = dict(loss.named_children())["target_actor_network_params"]
        # The mistake: without preserve_module_state=False the targets become Parameters.
        with target.to_module(loss.actor_network):
            pass
        message = "target_actor_network_params requires a gradient.*preserve_module_state=False"
        with pytest.raises(RuntimeError, match=message):
            PolyakAverage(loss)
        assert not any(networks_with_updater(loss).values())

    def test_step_before_init(self):
        updater = PeriodicCopy(sac(), interval=1)
        updater.load_state_dict(updater.state_dict() | {"initialized": False})
        with pytest.raises(RuntimeError, match=r"Call \w+\.init_\(\) before step\(\)"):
            updater.step()


class TestUpdaterSequence:
    def test_is_an_updater_of_the_loss(self):
        loss = sac()
        copies = PeriodicCopy(loss, "actor_network", interval=2)
        averages = PolyakAverage(loss, "qvalue_network")
        sequence = UpdaterSequence(copies, UpdaterSequence(averages))
        assert isinstance(sequence, TargetNetUpdater)
        assert sequence.loss_module is loss
        assert sequence.initialized
        train(loss)
        sequence.init_()
        assert all(is_level(loss, name) for name in ("actor_network", "qvalue_network"))
        with pytest.raises(ValueError, match="target_qvalue_network_params has two updaters"):
            UpdaterSequence(sequence, averages)

    def test_warns_about_a_forgotten_network(self):
        loss = sac()
        copies = PeriodicCopy(loss, "actor_network", interval=2)
        message = r"No updater follows the delayed network\(s\) \['qvalue_network'\]"
        with pytest.warns(UserWarning, match=message):
            UpdaterSequence(copies)
        with pytest.warns(UserWarning, match="No target network updater has been associated"):
            loss(batch())
        UpdaterSequence(copies, PolyakAverage(loss, "qvalue_network"))
        loss(batch())

    @pytest.mark.parametrize(
        ("make_updaters", "message"),
        [
            (lambda a, b: [PolyakAverage(a), PolyakAverage(b)], "must belong to one loss"),
            (
                lambda a, b: [PolyakAverage(a), PeriodicCopy(a, "actor_network", interval=2)],
                "target_actor_network_params has two updaters, PolyakAverage and PeriodicCopy",
            ),
            (
                lambda a, b: [SoftUpdate(a, tau=0.1), PolyakAverage(a, "qvalue_network")],
                "target_qvalue_network_params has two updaters, SoftUpdate and PolyakAverage",
            ),
        ],
    )
    def test_refuses(self, make_updaters, message):
        with pytest.raises(ValueError, match=message):
            UpdaterSequence(*make_updaters(sac(), sac()))


class TestCheckpoints:
    def test_a_resumed_run_is_the_uninterrupted_run(self):
        def both(loss):
            return UpdaterSequence(
                PeriodicCopy(loss, "actor_network", interval=3),
                PolyakAverage(loss, "qvalue_network", weight=0.25),
            )

        def run(loss, updater, calls):
            for call in calls:
                torch.manual_seed(call)
                train(loss)
                updater.step()

        straight, first, resumed = sac(), sac(), sac()
        first.load_state_dict(straight.state_dict())
        updater = both(straight)
        run(straight, updater, range(11))

        interrupted = both(first)
        run(first, interrupted, range(4))
        file = io.BytesIO()
        torch.save({"loss": first.state_dict(), "updater": interrupted.state_dict()}, file)
        file.seek(0)
        saved = torch.load(file, weights_only=True)
        continued = both(resumed)
        resumed.load_state_dict(saved["loss"])
        continued.load_state_dict(saved["updater"])
        assert continued.state_dict() == interrupted.state_dict()
        run(resumed, continued, range(4, 11))

        assert continued.state_dict() == updater.state_dict()
        assert continued.state_dict()["updaters"][0] == {"initialized": True, "counter": 11 % 3}
        for name in ("target_actor_network", "target_qvalue_network"):
            assert equal(snapshot(resumed, name), snapshot(straight, name))

    def test_a_state_of_another_kind_is_refused(self):
        loss = sac()
        copies = PeriodicCopy(loss, "actor_network", interval=2)
        averages = PolyakAverage(loss, "qvalue_network")
        sequence = UpdaterSequence(copies, averages)
        half = PolyakAverage(sac().half(), "actor_network")
        refused = [
            (copies, averages.state_dict(), r"PeriodicCopy has the entries \['counter', 'init"),
            (averages, copies.state_dict(), r"PolyakAverage has the entries \['initialized'\]"),
            (half, averages.state_dict(), r"entries \['averages', 'initialized'\], got \['ini"),
            (sequence, copies.state_dict(), "one entry, 'updaters', with 2 states"),
            (sequence, {"updaters": [copies.state_dict()]}, "one entry, 'updaters', with 2"),
            (
                UpdaterSequence(PeriodicCopy(half.loss_module, "qvalue_network", interval=5), half),
                {
                    "updaters": [
                        {"initialized": True, "counter": 3},
                        {"initialized": True, "averages": None},
                    ]
                },
                "averages must be",
            ),
            (
                sequence,
                {"updaters": [{"initialized": True, "counter": 7}, {"initialized": "no"}]},
                "initialized must be",
            ),
        ]
        for updater, state, message in refused:
            before = updater.state_dict()
            with pytest.raises((ValueError, TypeError), match=message):
                updater.load_state_dict(state)
            torch.testing.assert_close(updater.state_dict(), before)
