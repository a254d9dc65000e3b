"""Actors and critics."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, set_skip_existing
from torch import nn
from torchrl.data import Bounded, Categorical, MultiCategorical, OneHot
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import MLP
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_ecpo import ECACLoss
from torchrl_ecpo.modules import (
    DenseNetwork,
    PixelEncoder,
    actor_critic,
    make_action_value_network,
    make_categorical_actor,
    make_deterministic_actor,
    make_qvalue_network,
    make_tanh_gaussian_actor,
    make_value_network,
)

SPEC = Bounded(low=torch.tensor([-2.0, -0.4]), high=torch.tensor([2.0, 1.0]))
ACTORS = [make_tanh_gaussian_actor, make_deterministic_actor]


def states(*batch_size, **entries):
    td = TensorDict({"observation": 9 * torch.randn(*batch_size, 3)}, batch_size=batch_size)
    return td.update(entries)


def copy_weights(network, mlp):
    layers = [layer for layer in mlp if isinstance(layer, nn.Linear)]
    for i, layer in enumerate(layers):
        layer.weight.data.copy_(getattr(network, f"weight_{i}"))
        layer.bias.data.copy_(getattr(network, f"bias_{i}"))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("hidden", [[], [8], [8, 5]])
@pytest.mark.parametrize("is_normal", [False, True])
def test_a_dense_network_computes_what_an_mlp_does(hidden, dtype, is_normal):
    network = DenseNetwork(["a", "b"], ["out"], [5, *hidden, 2], layer_norm=is_normal).to(dtype)
    norms = [{"normalized_shape": units, "elementwise_affine": False} for units in hidden]
    norm = {"norm_class": nn.LayerNorm, "norm_kwargs": norms} if is_normal else {}
    options = {"num_cells": hidden, "activation_class": nn.ReLU, **norm}
    mlp = MLP(in_features=5, out_features=2, **options).to(dtype)
    copy_weights(network, mlp)
    td = TensorDict(
        {"a": torch.randn(4, 7, 3, dtype=dtype), "b": torch.randn(4, 7, 2, dtype=dtype)}, [4, 7]
    )
    expected = TensorDictModule(mlp, ["a", "b"], ["out"])(td.clone())["out"]
    torch.testing.assert_close(network(td)["out"], expected)
    torch.testing.assert_close(network(a=td["a"], b=td["b"]), expected)


@pytest.mark.parametrize(("rows", "units"), [(4, 8), (64, 64)])
def test_each_of_several_sets_of_parameters_gives_what_vmap_does(rows, units):
    network, params = two_sets(units)
    b = torch.randn(rows, 36, requires_grad=True)
    inputs = TensorDict({"a": torch.randn(rows, 40), "b": b}, [rows])

    def call(params):
        with params.to_module(network, preserve_module_state=False):
            return network(inputs.copy())["out"]

    outputs = [network.each(inputs, params)["out"], torch.vmap(call)(params)]
    assert set(inputs.keys()) == {"a", "b"}
    torch.testing.assert_close(*outputs)
    leaves = [inputs["b"], *params.values()]
    gradients = [torch.autograd.grad(output.square().sum(), leaves) for output in outputs]
    torch.testing.assert_close(*gradients, atol=1e-4, rtol=1e-4)


def two_sets(*hidden):
    """A network of two inputs of 40 and 36 numbers, and two sets of parameters."""
    torch.manual_seed(0)
    networks = [DenseNetwork(["a", "b"], ["out"], [76, *hidden, 2]) for _ in range(2)]
    return networks[0], TensorDict.from_modules(*networks).data.requires_grad_()


def repeated_inputs(keys, *batch_shape):
    inputs = TensorDict(a=torch.randn(*batch_shape, 40), b=torch.randn(*batch_shape, 36))
    for key in keys:
        inputs[key] = inputs[key][:1].expand_as(inputs[key])
    return inputs


@pytest.mark.parametrize("hidden", [[], [40]])
@pytest.mark.parametrize(("repeated", "times"), [("", 0), ("a", 2), ("b", 2), ("ab", 0)])
@pytest.mark.parametrize("batch_shape", [(8, 50), (8, 5, 10)])
def test_what_is_repeated_is_multiplied_once(monkeypatch, hidden, repeated, times, batch_shape):
    network, params = two_sets(*hidden)
    inputs = repeated_inputs(repeated, *batch_shape)
    rows = []

    def product(x, *layer):
        rows.append(x.shape[:-1].numel())
        return torch.nn.functional.linear(x, *layer)

    monkeypatch.setattr(actor_critic, "linear", product)
    expected = network.each(inputs.contiguous(), params)["out"]
    assert set(rows) == {400}
    rows.clear()
    output = network.each(inputs, params)["out"]
    assert rows.count(50) == times
    assert set(rows) <= {50, 400}
    torch.testing.assert_close(output, expected)
    gradients = [
        torch.autograd.grad(result.square().sum(), list(params.values()))
        for result in (output, expected)
    ]
    torch.testing.assert_close(*gradients, atol=1e-4, rtol=1e-4)


def test_what_is_repeated_and_has_a_gradient_gets_that_of_each_copy():
    network, params = two_sets(40)
    inputs = repeated_inputs("a", 8, 50)
    b = inputs["b"]

    def output(a):
        return network.each(TensorDict(a=a, b=b), params)["out"].square().sum()

    a, copy = (x.requires_grad_() for x in (inputs["a"], inputs["a"].contiguous()))
    gradients = [torch.autograd.grad(output(x), x) for x in (a, copy)]
    torch.testing.assert_close(*gradients)
    several = torch.func.grad(lambda a: torch.vmap(output)(a).sum())
    expanded = copy.detach()[:1].expand(4, 8, 50, 40)
    torch.testing.assert_close(several(expanded), several(expanded.contiguous()))


def test_what_is_repeated_may_be_mapped_over():
    network, params = two_sets(40)
    inputs, states = repeated_inputs("", 8, 50), torch.randn(3, 50, 40)

    def output(state):
        a = state.expand(8, 50, 40)
        return network.each(TensorDict(a=a, b=inputs["b"]), params)["out"]

    expected = torch.stack([output(state) for state in states])
    torch.testing.assert_close(torch.vmap(output)(states), expected)


def test_what_is_repeated_is_read_as_its_copy_would_be():
    network, params = two_sets(40)
    inputs = repeated_inputs("a", 8, 50)
    whole = TensorDict(a=inputs["a"], b=inputs["b"].gt(0))
    copied = TensorDict(a=inputs["a"].contiguous(), b=whole["b"])
    outputs = [network.each(entries, params)["out"] for entries in (whole, copied)]
    torch.testing.assert_close(*outputs)
    for shape in ((16, 25, 36), (400, 36), (8, 25, 2, 36)):
        with pytest.raises(ValueError, match=r"Sizes of tensors must match|same number of dim"):
            network.each(TensorDict(a=inputs["a"], b=torch.zeros(shape)), params)


@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
def test_a_dense_network_compiles_as_a_whole():
    network, params = two_sets(40)
    inputs = repeated_inputs("a", 8, 50)
    torch._dynamo.reset()
    compiled = torch.compile(network.each, fullgraph=True, backend="eager")
    outputs = [call(inputs, params)["out"] for call in (network.each, compiled)]
    torch.testing.assert_close(*outputs)
    leaves = list(params.values())
    gradients = [torch.autograd.grad(output.square().sum(), leaves) for output in outputs]
    torch.testing.assert_close(*gradients, atol=1e-4, rtol=1e-4)


def test_a_dense_network_starts_as_layers_of_torch_do():
    torch.manual_seed(0)
    network = DenseNetwork(["a"], ["out"], [100, 400, 1])
    for name, fan_in in (("weight_0", 100), ("bias_0", 100), ("weight_1", 400)):
        values = getattr(network, name).detach()
        assert values.abs().max() <= fan_in**-0.5
        assert values.std().item() == pytest.approx(fan_in**-0.5 / 3**0.5, rel=0.1)
    before = network.weight_0.detach().clone()
    network.reset_parameters()
    assert (network.weight_0 != before).float().mean() > 0.99


def test_a_dense_network_is_drawn_anew_as_tensordict_asks_for_it():
    """Also several sets of parameters at once, as of the critics of a loss."""
    actor = make_tanh_gaussian_actor(3, Bounded(-1.0, 1.0, shape=(2,)))
    loss = ECACLoss(actor, make_qvalue_network(3, 2), make_value_network(3))
    old = {name: value.clone() for name, value in loss.state_dict().items()}
    loss.reset_parameters_recursive()
    drawn = {name for name, value in loss.state_dict().items() if (value != old[name]).any()}
    assert drawn == {name for name in old if "params" in name and "__batch_size" not in name}
    first, second = loss.qvalue_network_params.unbind(0)
    assert (first["weight_0"] != second["weight_0"]).all()

    network = DenseNetwork(["a"], ["out"], [3, 4, 1], final_gain=0)
    own, given = network.weight_0.detach().clone(), TensorDict.from_module(network).data.clone()
    before = given.clone()
    drawn = network.reset_parameters_recursive(given)
    assert (given["weight_0"] != before["weight_0"]).all()
    torch.testing.assert_close(drawn["weight_0"], given["weight_0"])
    assert (given["weight_1"] == 0).all()
    assert torch.equal(network.weight_0, own)
    with pytest.raises(RuntimeError, match="batched"):
        network.reset_parameters_recursive(given.expand(2))


def test_a_dense_network_skips_what_exists_where_it_is_asked_to():
    network, value = DenseNetwork(["a"], ["out"], [3, 1]), torch.full((5, 1), 7.0)
    with set_skip_existing(True):
        written = network(TensorDict(a=torch.zeros(5, 3), out=value))["out"]
    assert torch.equal(written, value)
    assert (network(TensorDict(a=torch.zeros(5, 3), out=value))["out"] != value).all()


def test_a_final_gain_is_a_factor_of_the_last_layer_alone():
    def start(**options):
        torch.manual_seed(0)
        return DenseNetwork(["a"], ["out"], [100, 50, 2], **options)

    usual, small = start(), start(final_gain=0.01)
    for again in (False, True):
        if again:
            for network in (usual, small):
                torch.manual_seed(1)
                network.reset_parameters()
        for name, parameter in small.named_parameters():
            factor = 0.01 if name.endswith("_1") else 1.0
            torch.testing.assert_close(parameter, factor * getattr(usual, name))
    assert start(final_gain=0)(a=torch.randn(5, 100)).abs().max() == 0


def test_with_a_small_final_gain_a_policy_starts_in_the_middle_whatever_it_observes():
    large = TensorDict({"observation": 300 * torch.randn(200, 50)}, [200])

    def start(**options):
        torch.manual_seed(0)
        return make_tanh_gaussian_actor(50, SPEC, **options).get_dist(large)

    assert start().base_dist.base_dist.loc.abs().max() > 20
    small = start(final_gain=0.01)
    assert small.base_dist.base_dist.loc.abs().max() < 1
    torch.testing.assert_close(small.scale.log(), torch.zeros(200, 2), atol=1.0, rtol=0)


@pytest.mark.parametrize("make", ACTORS)
@pytest.mark.parametrize("exploration", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
def test_actions_fill_their_bounds_and_stay_within(make, exploration):
    torch.manual_seed(0)
    actor = make(3, SPEC, hidden_sizes=[16])
    with torch.no_grad(), set_exploration_type(exploration):
        for parameter in actor.parameters():
            parameter.mul_(5)
        actions = actor(states(2000))["action"]
    assert ((actions >= SPEC.space.low) & (actions <= SPEC.space.high)).all()
    covered = (actions.amax(0) - actions.amin(0)) / (SPEC.space.high - SPEC.space.low)
    assert (covered > 0.95).all()


def test_the_scale_is_one_at_first_and_is_cut_off():
    torch.manual_seed(0)
    actor = make_tanh_gaussian_actor(3, SPEC)
    near = TensorDict({"observation": 0.1 * torch.randn(50, 3)}, [50])
    torch.testing.assert_close(actor.get_dist(near).scale, torch.ones(50, 2), atol=0.15, rtol=0)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.mul_(10)
    scales = actor.get_dist(states(200)).scale.log()
    assert scales.min().item() == pytest.approx(-5.0)
    assert scales.max().item() == pytest.approx(2.0)


@pytest.mark.parametrize("deactivate_vmap", [False, True])
def test_torchrl_s_sac_trains_them(deactivate_vmap):
    torch.manual_seed(0)
    actor = make_tanh_gaussian_actor(3, SPEC, hidden_sizes=[8])
    qvalue = make_qvalue_network(3, 2, hidden_sizes=[8])
    value = make_value_network(3, hidden_sizes=[8])
    batch = states(
        6,
        action=SPEC.rand([6]),
        next=states(6, reward=torch.randn(6, 1), done=torch.zeros(6, 1, dtype=torch.bool)),
    )
    batch["next", "terminated"] = batch["next", "done"].clone()
    for critics in ([qvalue], [qvalue, value]):
        loss_module = SACLoss(actor, *critics, deactivate_vmap=deactivate_vmap)
        SoftUpdate(loss_module, tau=0.1)
        losses = loss_module(batch)
        sum(loss for name, loss in losses.items() if name.startswith("loss_")).backward()
        assert all(
            parameter.grad is not None and parameter.grad.abs().sum() > 0
            for parameter in loss_module.parameters()
        )
        assert next(actor.parameters()).grad is not None


@pytest.mark.parametrize("make", ACTORS)
@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (OneHot(4), "got OneHot. Discrete actions belong to DiscreteECACLoss"),
        (Bounded(-1.0, 1.0, shape=(5, 2)), r"one vector, got the shape \(5, 2\)"),
        (Bounded(0.0, torch.inf, shape=(2,)), r"finite bounds.*got \[0.0, 0.0\] to \[inf, inf\]"),
        (Bounded(-3e38, 3e38, shape=(1,)), "finite bounds.*at a finite distance, got"),
        (Bounded(1.0, 1.0, shape=(1,)), r"the upper one above.*got \[1.0\] to \[1.0\]"),
    ],
)
def test_other_actions_are_refused(make, spec, message):
    with pytest.raises(ValueError, match=message):
        make(3, spec)


def test_an_encoder_scales_bytes_and_keeps_any_batch():
    encoder = PixelEncoder((2, 20, 7))
    bytes_ = torch.randint(256, (4, 3, 2, 20, 7), dtype=torch.uint8)
    features = encoder(bytes_)
    assert features.shape == (4, 3, encoder.size)
    assert encoder.size == 2 * 1 * 32  # 20 becomes 10, 5, 3, 2 and 7 becomes 4, 2, 1, 1
    expected = encoder.convolutions(bytes_[1, 2].float() / 255)
    torch.testing.assert_close(features[1, 2], expected)
    torch.testing.assert_close(encoder(bytes_ / 255), features)  # as ToTensorImage has them


@pytest.mark.parametrize("observation_size", [3, (1, 9, 9)])
def test_networks_of_vectors_and_of_pixels_write_the_same_entries(observation_size):
    """And no others, which would go into the replay buffer."""
    pixels = torch.zeros(5, 1, 9, 9, dtype=torch.uint8)
    observation = torch.zeros(5, 3) if observation_size == 3 else pixels
    batch = TensorDict(observation=observation, batch_size=[5])
    discrete = make_categorical_actor(observation_size, Categorical(4))(batch.clone())
    assert {*discrete.keys()} == {"observation", "logits", "action"}
    assert discrete["action"].shape == (5,)
    actor = make_tanh_gaussian_actor(observation_size, SPEC)(batch.clone())
    assert {*actor.keys()} == {"observation", "loc", "scale", "action"}
    deterministic = make_deterministic_actor(observation_size, SPEC)(batch.clone())
    assert {*deterministic.keys()} == {"observation", "pre_tanh", "action"}
    values = make_action_value_network(observation_size, 4)(batch.clone())
    assert values["action_value"].shape == (5, 4)
    assert "features" not in values
    qvalue = make_qvalue_network(observation_size, 2)(actor)
    assert qvalue["state_action_value"].shape == (5, 1)


@pytest.mark.parametrize("spec", [Categorical(3, shape=(2,)), MultiCategorical([2, 3]), SPEC, 4])
def test_a_categorical_actor_takes_one_discrete_action(spec):
    with pytest.raises(ValueError, match="action_spec must be of one discrete action"):
        make_categorical_actor(3, spec)
