"""What is particular to ECAC: closed forms of the lift, exact sums, and the two projections."""

from __future__ import annotations

import math

import pytest
import torch
from actor_critic_problems import (
    ACTION,
    CASES,
    CHOICES,
    FIXED,
    call,
    gradients,
    lift_by_summation,
    make_batch,
    make_networks,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Beta, Categorical, Independent, Normal, kl_divergence
from torch.testing import assert_close
from torchrl.modules import IndependentNormal, ProbabilisticActor, TanhNormal, ValueOperator

from torchrl_ecpo import DiscreteECACLoss, ECACLoss, PeriodicCopy
from torchrl_ecpo.functional import (
    centred_gaussian_projection,
    lifted_gaussian_moments,
    mean_seeking_projection,
)
from torchrl_ecpo.objectives.actions import PairedActions, gaussian_parameters

CASE, DISCRETE = CASES["ecac"], CASES["discrete_ecac"]
TEMPERATURES = pytest.mark.parametrize(
    ("tau", "tau_prime"), [(0.5, 0.25), (0.3, 0.0), (0.0, 0.4), (2.0, 5.0)]
)
LOC, SCALE = torch.tensor([[0.3, -0.5], [0.8, 0.4]], dtype=torch.float64)

# ------------------------------------------------------------------------- one state, one Gaussian


class _Parameters(nn.Module):
    """A policy's parameters that do not depend on the state."""

    def __init__(self, *parameters: torch.Tensor) -> None:
        super().__init__()
        self.parameters_ = nn.ParameterList(parameters)

    def forward(self, observation):
        return tuple(p.expand(*observation.shape[:-1], -1) for p in self.parameters_)


class _Score(nn.Module):
    """Q as a function of the action alone."""

    def __init__(self, function) -> None:
        super().__init__()
        self.function = function
        self.offset = nn.Parameter(torch.zeros((), dtype=torch.float64))

    def forward(self, observation, action):
        return self.function(action).sum(-1, keepdim=True) + self.offset


def gaussian_actor(distribution=IndependentNormal):
    """One Gaussian, whatever the state."""
    parameters = _Parameters(LOC.clone(), SCALE.clone())
    return ProbabilisticActor(
        TensorDictModule(parameters, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=distribution,
    )


def gaussian_bandit(function, *, distribution=IndependentNormal, loss=ECACLoss, **options):
    """A loss for that policy and a known Q."""
    qvalue = ValueOperator(_Score(function), ["observation", "action"])
    options = {"num_qvalue_nets": 1, "delay_qvalue": False, **FIXED, **options}
    return loss(gaussian_actor(distribution), qvalue, **options).double()


def states(*shape: int) -> TensorDict:
    """Nothing to see."""
    observation = torch.zeros(*shape, 1, dtype=torch.float64)
    return TensorDict({"observation": observation}, batch_size=shape)


def lifted(loss, batch, m: int, seed: int = 0):
    torch.manual_seed(seed)
    policy = loss.states(batch).policy
    return loss.lift(batch, policy, loss.qvalue_network_params, m)


SCORES = {  # slope, curvature: Q = slope a - curvature a^2 / 2
    "linear": ((0.4, -0.2), (0.0, 0.0)),
    "quadratic": ((0.4, -0.2), (0.5, 2.0)),
    "flat": ((0.0, 0.0), (0.0, 0.0)),
}


def quadratic(name: str):
    """Q of that name."""
    slope, curvature = torch.tensor(SCORES[name], dtype=torch.float64)
    return lambda a: slope * a - curvature * a**2 / 2


def _target(name: str, tau: float, tau_prime: float):
    """pi_bar^(tau/k) exp(Q/k), k = tau + tau': a Gaussian; and the value k log of its integral."""
    slope, curvature = torch.tensor(SCORES[name], dtype=torch.float64)
    total = tau + tau_prime
    precision = (curvature + tau / SCALE**2) / total
    mean = (slope + tau * LOC / SCALE**2) / (total * precision)
    normaliser = 0.5 * math.log(2 * math.pi) - 0.5 * precision.log() + precision * mean**2 / 2
    reference = -0.5 * (LOC / SCALE) ** 2 - SCALE.log() - 0.5 * math.log(2 * math.pi)
    value = (total * normaliser + tau * reference).sum()
    return Normal(mean, precision**-0.5), value


@pytest.mark.parametrize("name", SCORES)
@pytest.mark.parametrize(("tau", "tau_prime"), [(0.5, 0.25), (1.0, 0.0), (0.6, 0.05)])
def test_lift_of_a_gaussian_by_a_quadratic_is_that_gaussian(name, tau, tau_prime):
    """Mean, variance, soft value and KL(target, pi_bar), within four standard errors."""
    loss = gaussian_bandit(quadratic(name), tau=tau, tau_prime=tau_prime)
    target, value = _target(name, tau, tau_prime)
    lift = lifted(loss, states(64), 4_000)
    weights, samples = lift.weights.unsqueeze(-1), lift.actions.latent
    mean = (weights * samples).sum(0)
    variance = (weights * (samples - mean) ** 2).sum(0)
    reference = Normal(LOC, SCALE)
    divergence = (lift.weights * (lift.weights * 4_000).log()).sum(0)
    for estimate, expected in (
        (mean, target.mean),
        (variance, target.variance),
        (lift.value, value),
        (divergence, kl_divergence(target, reference).sum()),
    ):
        standard_error = estimate.std(0) / math.sqrt(64)
        assert ((estimate.mean(0) - expected).abs() < 4 * standard_error + 1e-3).all()


@TEMPERATURES
def test_flat_score_and_no_entropy_leave_the_reference_where_it_is(tau, tau_prime):
    """Equal weights at tau' = 0; else the target is pi_bar^(tau / (tau + tau'))."""
    loss = gaussian_bandit(torch.zeros_like, tau=tau, tau_prime=tau_prime)
    lift = lifted(loss, states(5), 16)
    if tau_prime == 0:
        assert_close(lift.weights, torch.full_like(lift.weights, 1 / 16))
        assert_close(lift.value, torch.zeros(5).double())
    expected = (-tau_prime / (tau + tau_prime) * lift.actions.log_prob).softmax(0)
    assert_close(lift.weights, expected)


def test_sampled_lift_converges_to_the_exact_one():
    """The root mean square error falls like 1 / sqrt(M): tenfold for a hundred times M."""
    loss = gaussian_bandit(quadratic("quadratic"), tau=0.5, tau_prime=0.25)
    target, value = _target("quadratic", 0.5, 0.25)
    divergence = kl_divergence(target, Normal(LOC, SCALE)).sum()
    errors = []
    for m in (20, 2_000):
        lift = lifted(loss, states(400), m)
        mean = (lift.weights.unsqueeze(-1) * lift.actions.latent).sum(0)
        estimated = lift.actions.divergence_of(lift.weights, lift.log_weights)
        pairs = ((mean, target.mean), (lift.value, value), (estimated, divergence))
        errors.append(torch.stack([(x - y).square().mean().sqrt() for x, y in pairs]))
    few, many = errors
    assert ((few / many > 7) & (few / many < 14)).all()
    assert (many < 0.03).all()


# --------------------------------------------------------------------------------- the projections


@pytest.mark.parametrize("kind", ["tanh_normal", "normal", "bounded"])
def test_projection_is_the_function_of_that_name(kind):
    """On the pre-tanh samples; with the paper's the log-volume adds a constant.

    They share the gradient of the mean, and differ in that of the scale.
    """
    by_name = {}
    for projection in ("centred", "paper"):
        loss = CASE.build(make_networks(kind), projection=projection, reduction="none")
        at = loss.states(make_batch(kind))
        torch.manual_seed(0)
        actual, actions, log_weights = loss.project(at).loss, at.lift.actions, at.lift.log_weights
        if projection == "centred":
            expected = centred_gaussian_projection(
                *gaussian_parameters(at.policy), actions.latent, log_weights, sample_dim=0
            )
        else:
            log_prob = at.policy.log_prob(actions.action)
            expected = mean_seeking_projection(log_prob, log_weights, sample_dim=0)
        assert_close(actual, expected.loss)
        grads = gradients(loss, actual.sum())
        by_name[projection] = next(g for name, g in grads.items() if name.endswith("0.bias"))
    difference = by_name["centred"] - by_name["paper"]
    assert_close(difference[:ACTION], torch.zeros(ACTION).double())
    assert difference[ACTION:].abs().min() > 1e-3


@pytest.mark.parametrize("projection", ["centred", "paper"])
def test_gradient_vanishes_at_the_projection(projection):
    """A delayed reference, and a policy that is the lift of it already."""
    target, _ = _target("quadratic", 0.5, 0.25)

    def gradient(loc, scale):
        loss = gaussian_bandit(
            quadratic("quadratic"),
            tau=0.5,
            tau_prime=0.25,
            projection=projection,
            delay_actor=True,
            num_action_samples=64,
        )
        PeriodicCopy(loss, "actor_network", interval=1_000)
        for parameter, value in zip(loss.actor_network.parameters(), (loc, scale), strict=True):
            parameter.data.copy_(value)
        torch.manual_seed(0)
        divergence = loss.project(loss.states(states(2_000))).loss.mean()
        return torch.stack(torch.autograd.grad(divergence, list(loss.actor_network.parameters())))

    there = gradient(target.mean, target.stddev)
    elsewhere = gradient(target.mean + 0.3, 1.3 * target.stddev)
    assert there.norm() < 0.05 * elsewhere.norm()


def test_a_tanh_policy_is_projected_as_the_gaussian_below_it():
    """With Q(tanh u) for Q(u): at tau' = 0 the Jacobian is in none of the weights."""
    outputs = []
    for distribution, function in (
        (TanhNormal, torch.square),
        (IndependentNormal, lambda u: u.tanh() ** 2),
    ):
        loss = gaussian_bandit(function, distribution=distribution, tau=0.4, tau_prime=0.0)
        torch.manual_seed(0)
        at = loss.states(states(6))
        divergence, lift = loss.project(at).loss, at.lift
        grads = torch.autograd.grad(divergence.sum(), list(loss.actor_network.parameters()))
        outputs.append((divergence, lift.weights, *grads))
    assert_close(*outputs)


def not_gaussian():
    """Networks whose policy is a Beta distribution."""
    networks = make_networks()
    networks.actor = ProbabilisticActor(
        networks.actor[0],  # type: ignore
        in_keys=["loc", "scale"],
        distribution_class=lambda loc, scale: Independent(Beta(loc.exp(), scale), 1),
    )
    return networks


def test_policy_that_is_no_gaussian():
    """The paper's projection takes it."""
    loss = CASE.build(not_gaussian(), projection="paper")
    outputs = call(loss, make_batch())
    assert all(output.isfinite() for output in outputs.values())
    grads = gradients(loss, outputs["loss_actor"])
    assert any(g.abs().max() > 0 for name, g in grads.items() if "actor" in name)


# ------------------------------------------------------------------------- by the gradient of Q

PAIRED = {"projection": "gradient", "num_action_samples": 4}


@pytest.mark.parametrize("delay", [False, True])
@pytest.mark.parametrize("width_entropy", [1.0, 0.4])
@pytest.mark.parametrize("name", ["linear", "quadratic"])
def test_moments_by_the_gradient_are_those_of_the_target(name, width_entropy, delay):
    """Exact for two actions; the gradients are at the policy, the moments of the reference."""
    tau, tau_prime = 0.5, 0.25
    loss = gaussian_bandit(
        quadratic(name),
        tau=tau,
        tau_prime=tau_prime,
        delay_actor=delay,
        width_entropy=width_entropy,
        **PAIRED | {"num_action_samples": 2},
    )
    loc, scale = loss.actor_network.parameters()
    if delay:
        PeriodicCopy(loss, "actor_network", interval=1_000)
        loc.data += 0.3
        scale.data *= 1.5
    surrogate = loss.project(loss.states(states(3)))
    target, _ = _target(name, tau, tau_prime)
    variance = target.variance * (tau + width_entropy * tau_prime) / (tau + tau_prime)
    expected = ((loc - target.mean) / scale**2, 1 / scale - variance / scale**3)
    assert_close(torch.autograd.grad(surrogate.loss.sum() / 3, (loc, scale)), expected)
    divergence = kl_divergence(Normal(target.mean, variance.sqrt()), Normal(LOC, SCALE)).sum()
    assert_close(surrogate.metrics["kl_target_reference"], divergence.expand(3))


@pytest.mark.parametrize("kind", ["normal", "tanh_normal", "bounded"])
def test_slope_is_that_of_the_least_score_and_the_volume(kind):
    """By finite differences of Q(a(u)) + tau' log|da/du|; and its actions come in pairs."""
    loss = CASE.build(make_networks(kind), **PAIRED)
    at = loss.states(make_batch(kind))
    lift, (loc, _) = at.lift, gaussian_parameters(at.reference)
    first, second = lift.actions.latent.chunk(2)
    assert_close(first + second, 2 * loc.expand(2, -1, -1))
    assert not any(x.requires_grad for x in (lift.slope, lift.score, *lift.actions[:3]))

    def height(latent):
        actions = PairedActions.at(latent, at.reference)
        score = loss.score_of(at.observations, actions, loss.qvalue_network_params)
        return score + loss.tau_prime * actions.log_volume

    for i, step in enumerate(1e-5 * torch.eye(ACTION).double()):
        difference = height(lift.actions.latent + step) - height(lift.actions.latent - step)
        assert_close(lift.slope[..., i], difference / 2e-5, atol=1e-7, rtol=1e-5)


def test_only_real_states_are_pooled():
    """As if the others were not there; also among the first states of a batch."""
    mask = torch.tensor([True, False, True, True, False, True])
    batch = make_batch().set(("collector", "mask"), mask)
    loss = CASE.build(**PAIRED, reduction="none")
    at = loss.states(batch, mask)
    loss_actor, lift = loss.project(at).loss, at.lift
    loc, scale = (x[mask].detach() for x in gaussian_parameters(at.reference))
    shift, width = lifted_gaussian_moments(
        (lift.actions.latent[:, mask] - loc) / scale,
        lift.slope[:, mask] * scale,
        lift.log_weights[:, mask],
        tau=loss.tau,
        tau_prime=loss.tau_prime,
        sample_dim=0,
    )
    expected = (scale.log() + 0.5 * (width + shift**2 + math.log(2 * math.pi))).sum(-1)
    assert_close(loss_actor[mask], expected)
    assert_close(call(loss, batch)["loss_actor"][~mask], torch.zeros(2).double())
    assert call(CASE.build(**PAIRED, num_actor_states=4), batch)["loss_actor"].isfinite()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("options", [{"tau": 0.0}, {"delay_actor": True}, {"value": True}], ids=str)
def test_gradient_projection_reaches_the_policy_alone(dtype, options):
    """Also without gradients around it, at tau = 0 and with a delayed policy."""
    loss = CASE.build(make_networks(dtype=dtype), **PAIRED, **options)
    batch = make_batch(dtype=dtype)
    outputs = call(loss, batch)
    assert all(value.isfinite().all() for value in outputs.values())
    reached = {n for n, g in gradients(loss, outputs["loss_actor"]).items() if g.abs().max() > 0}
    assert {name.split(".")[0] for name in reached} == {"actor_network_params"}
    with torch.no_grad():
        assert_close(call(loss, batch), outputs)


def test_tau_is_learned_by_the_divergence_of_the_gaussians():
    """Gradients show more than the log M of samples: 2 * 0.8 nats are allowed."""
    outputs = call(CASE.build(**PAIRED, target_kl=0.8), make_batch())
    excess = (outputs["kl_target_reference"] / 1.6 - 1).clamp(-1, 1)
    assert_close(outputs["loss_tau"].detach(), -math.log(CASE.tau) * excess)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_action_samples": 5}, r'must be even with projection="gradient".*pairs, got 5'),
        ({"width_entropy": 1.5}, r"width_entropy must be in \[0, 1\], got 1.5"),
        ({"width_entropy": "a"}, "width_entropy must be a number, got 'a'"),
        (
            {"projection": "paper", "width_entropy": 0.4},
            "width_entropy is an option of projection=\"gradient\".*got 0.4 with 'paper'",
        ),
    ],
    ids=str,
)
def test_options_of_the_gradient(options, message):
    with pytest.raises(ValueError, match=message):
        CASE.build(**PAIRED | options)


def test_the_gradient_of_q_is_not_for_inference_mode():
    loss = CASE.build(**PAIRED)
    with torch.inference_mode(), pytest.raises(ValueError, match=r"torch.no_grad\(\)"):
        call(loss, make_batch())


def test_what_has_no_gradient():
    """A policy that is no Gaussian, and a critic that is not differentiable in the action."""
    with pytest.raises(ValueError, match=r"needs a diagonal Gaussian.*got Independent"):
        call(CASE.build(not_gaussian(), **PAIRED), make_batch())
    loss = gaussian_bandit(torch.Tensor.detach, distribution=TanhNormal, **PAIRED)
    with pytest.raises(ValueError, match=r"qvalue_network that is differentiable in the action"):
        loss.project(loss.states(states(3)))


def test_saturation_is_of_the_range_of_the_actions():
    """The outer 5 % of it; none without a range."""
    saturation = {}
    for kind in ("tanh_normal", "bounded", "normal"):
        networks = make_networks(kind)
        networks.actor[0].module[0].bias.data[:ACTION] = 2.0  # type: ignore
        saturation[kind] = call(CASE.build(networks), make_batch(kind))["saturation"]
    assert saturation["tanh_normal"] == saturation["bounded"]
    assert 0.2 < saturation["bounded"] < 1
    assert saturation["normal"] == 0


# ------------------------------------------------------------------------------- discrete, by hand


class _Table(nn.Module):
    """A row for each state; states are observed as one-hot vectors."""

    def __init__(self, rows) -> None:
        super().__init__()
        self.rows = nn.Parameter(torch.tensor(rows, dtype=torch.float64))

    def forward(self, observation):
        return observation @ self.rows


def tabular(logits, *tables, **options):
    """Of a policy and two tables of Q, or twice the same one."""
    actor = ProbabilisticActor(
        TensorDictModule(_Table(logits), ["observation"], ["logits"]),
        in_keys=["logits"],
        distribution_class=Categorical,
    )
    first, second = tables * 2 if len(tables) == 1 else tables
    qvalues = [
        TensorDictModule(_Table(t), ["observation"], ["action_value"]) for t in (first, second)
    ]
    loss = DiscreteECACLoss(actor, qvalues, delay_qvalue=False, **FIXED, **options)
    return loss.make_value_estimator(gamma=0.5).double()


def transition(state: int, action: int, reward: float, following: int, *, terminated=False):
    """In a problem of two states."""
    rows = torch.eye(2, dtype=torch.float64)
    end = torch.tensor([[terminated]])
    return TensorDict(
        {
            "observation": rows[state : state + 1],
            "action": torch.tensor([action]),
            "next": {
                "observation": rows[following : following + 1],
                "reward": torch.tensor([[reward]], dtype=torch.float64),
                "done": end,
                "terminated": end.clone(),
            },
        },
        batch_size=[1],
    )


def test_discrete_lift_and_losses_by_hand():
    """tau = tau' = 1, pi_bar = (1/4, 3/4), min Q = (2 log 2, 2 log 3), in the first state."""
    log = math.log
    loss = tabular(
        [[log(1), log(3)], [0.0, 0.0]],
        [[2 * log(2), 2 * log(3)], [0.0, 2 * log(3)]],
        [[2 * log(2) + 1, 2 * log(3) + 1], [7.0, 7.0]],
        tau=1.0,
        tau_prime=1.0,
    )
    batch = transition(0, 1, 10.0, 1)
    outputs = loss(batch)
    # exp((Q + log pi_bar) / 2) = 2 * 1/2, 3 * sqrt(3)/2
    first, second = 1.0, 1.5 * math.sqrt(3)
    target = torch.tensor([first, second], dtype=torch.float64) / (first + second)
    assert_close(outputs["state_value"].item(), 2 * log(first + second))
    cross_entropy = -target[0] * log(1 / 4) - target[1] * log(3 / 4)
    assert_close(outputs["loss_actor"], cross_entropy)
    assert_close(outputs["entropy"].item(), log(4) - 0.75 * log(3))
    divergence = target[0] * (4 * target[0]).log() + target[1] * (4 / 3 * target[1]).log()
    assert_close(outputs["kl_target_reference"], divergence)
    assert_close(outputs["qvalue"].item(), 0.25 * 2 * log(2) + 0.75 * 2 * log(3))
    # V(second state) = 2 log((1 + 3) / sqrt(2)), at gamma = 1/2; Q of the action is 2 log 3 (+ 1)
    bellman = 10 + 0.5 * 2 * log(4 / math.sqrt(2))
    errors = [2 * log(3) - bellman, 2 * log(3) + 1 - bellman]
    assert_close(outputs["loss_qvalue"].item(), sum(error**2 for error in errors))
    assert_close(batch["td_error"].item(), -errors[0])
    ended = transition(0, 1, 10.0, 1, terminated=True)
    loss(ended)
    assert_close(ended["td_error"].item(), 10 - 2 * log(3))


@TEMPERATURES
def test_discrete_gradient_is_policy_minus_target(tau, tau_prime):
    """With respect to the logits; at a delayed reference as well as at the policy itself."""
    networks = make_networks("categorical")
    for delay in (False, True):
        loss = DISCRETE.build(
            networks, tau=tau, tau_prime=tau_prime, delay_actor=delay, reduction="sum"
        )
        batch = make_batch("categorical")
        value = loss(batch)["loss_actor"]
        bias = next(g for name, g in gradients(loss, value).items() if name.endswith("0.bias"))
        target = lift_by_summation(
            networks.actor, networks.qvalues, batch["observation"], tau=tau, tau_prime=tau_prime
        ).weights
        probability = networks.actor.get_dist(batch).probs.detach().movedim(-1, 0)
        assert_close(bias, (probability - target).sum(-1))


def test_soft_values_of_a_tabular_problem_are_a_fixed_point():
    """Two states, known transitions: Q learned by the loss is Bellman's, and V Eq. 8's."""
    loss = tabular([[0.2, -0.4], [0.0, 0.3]], [[0.0, 0.0], [0.0, 0.0]], tau=0.3, tau_prime=0.2)
    dynamics = [(0, 0, 1.0, 1), (0, 1, 0.0, 0), (1, 0, -1.0, 0), (1, 1, 0.5, 1)]
    batch = torch.cat([transition(*arguments) for arguments in dynamics])
    optimizer = torch.optim.SGD(loss.qvalue_network_params.parameters(), 1.0)
    for _ in range(80):
        loss(batch)["loss_qvalue"].backward()
        optimizer.step()
        optimizer.zero_grad()
    reference = torch.tensor([[0.2, -0.4], [0.0, 0.3]]).double().log_softmax(-1)
    qvalue = torch.zeros(2, 2, dtype=torch.float64)
    for _ in range(100):
        value = 0.5 * ((qvalue + 0.3 * reference) / 0.5).exp().sum(-1).log()
        for state, action, reward, following in dynamics:
            qvalue[state, action] = reward + 0.5 * value[following]
    learned = loss.qvalue_network_params["module", "rows"][0].detach()
    assert_close(learned, qvalue, atol=1e-6, rtol=0)
    assert_close(loss(batch)["state_value"], value.mean(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("shape", [(6,), (6, 1)])
def test_a_single_action_by_its_number(shape):
    batch = make_batch("categorical")
    logit, value = (
        TensorDictModule(nn.Linear(3, 1), ["observation"], [key])
        for key in ("logits", "action_value")
    )
    actor = ProbabilisticActor(logit, ["logits"], distribution_class=Categorical)
    loss = DiscreteECACLoss(actor, value, target_kl=None, delay_qvalue=False).double()
    batch["action"] = torch.zeros(shape, dtype=torch.long)
    assert loss(batch)["entropy"] == 0


def test_actions_by_number_and_one_hot():
    """All forms of the same action give the same losses."""
    batch, loss = make_batch("categorical"), DISCRETE.build()
    number = batch["action"]
    expected = call(loss, batch)
    for action in (
        number.unsqueeze(-1),
        number.int(),
        nn.functional.one_hot(number, CHOICES),
        nn.functional.one_hot(number, CHOICES).double(),
        nn.functional.one_hot(number, CHOICES).bool(),
    ):
        assert_close(call(loss, batch.set("action", action)), expected)


@pytest.mark.parametrize("projection", ["centred", "gradient"])
def test_all_actions_have_no_estimator(projection):
    with pytest.raises(
        ValueError, match=f"projection must be one of .*'paper'.*got {projection!r}"
    ):
        DISCRETE.build(projection=projection)
