"""What is particular to each member over trajectories, and where two of them are one."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from torch.testing import assert_close
from torchrl.objectives import HardUpdate
from trajectory_problems import (
    CASES,
    DELAYED,
    MASK,
    expected_losses,
    gradients,
    make_actor,
    move,
    normalise,
    numbers,
    pad,
    problem,
    reinforce,
    sample,
    scored,
    scores,
    split,
)

from torchrl_ecpo.functional import mean_seeking_projection, soft_value_estimate
from torchrl_ecpo.objectives import (
    ECPOLoss,
    GRPOLoss,
    MENTLoss,
    PMDLoss,
    REPSLoss,
    RLOOLoss,
    SquaredPMDLoss,
    TPOLoss,
    UREXLoss,
)

CASE = CASES["ecpo"]
DrGRPOLoss = partial(GRPOLoss, score="return", aggregation="prompt_sum")


@pytest.mark.parametrize(
    ("loss_class", "tau", "tau_prime"),
    [
        *[(ECPOLoss, 0.5, 0.01), (PMDLoss, 0.5, 0.0), (SquaredPMDLoss, 0.5, 0.0)],
        *[(UREXLoss, 0.1, None), (MENTLoss, 0.01, None), (RLOOLoss, 0.0, None)],
        *[(TPOLoss, 1.0, None), (REPSLoss, 1.0, 0.0)],
    ],
)
def test_defaults(loss_class, tau, tau_prime):
    """As documented; the paper's PMD has no entropy term."""
    loss = loss_class(make_actor())
    assert_close(loss.temperature("tau"), torch.tensor(tau))
    if tau_prime is not None:
        assert_close(loss.tau_prime, torch.tensor(tau_prime))
    assert (loss.delay_actor, loss.reduction) == (False, "mean")
    assert not getattr(loss, "control_variate", False)


# ------------------------------------------------------------------------------------- the scores


@pytest.mark.parametrize("score", ["group", "batch"])
@pytest.mark.parametrize(
    ("name", "delayed"), [*[(name, False) for name in CASES], *[(name, True) for name in DELAYED]]
)
def test_scores_take_the_place_of_the_returns(name, delayed, score):
    case = replace(CASES[name], options=CASES[name].options | {"score": score})
    options = {"delay_actor": True} if delayed else {}
    loss, actor, batch = problem(case, lag=0.1 * delayed, **options)
    reference = [make_actor()] if delayed else []
    for each in reference:
        move(each, 0.1)
    groups = [numbers(actor, group, *reference) for group in split(batch)]
    options = {k: "return" if k == "score" else v for k, v in CASES[name].options.items()}
    expected = torch.stack(
        [case.formula(n, **case.temperatures, **options)[0] for n in scored(groups, score)]
    ).mean()
    out = loss(batch)
    assert_close(out["loss_actor"], expected)
    assert_close(gradients(out["loss_actor"], actor), gradients(expected, actor))
    assert_close(out["return"], torch.stack([n.returns.mean() for n in groups]).mean())


@pytest.mark.parametrize("score", ["group", "batch"])
def test_reps_bounds_the_lift_by_scores(score):
    """As if each trajectory's score were its first reward, and its only one."""
    actor = make_actor()
    batch = sample(actor, 5, 6, 4)
    groups = scored([numbers(actor, group) for group in split(batch)], score)
    with_scores = batch.clone()
    with_scores["next", "reward"].zero_()
    with_scores["next", "reward"][..., 0, 0] = torch.stack([n.returns for n in groups])
    names = ("loss_actor", "loss_tau", "kl_target_reference", "ESS", "max_weight")
    expected = REPSLoss(actor).double()(with_scores).select(*names)
    assert_close(REPSLoss(actor, score=score).double()(batch).select(*names), expected)


@pytest.mark.parametrize("score", ["group", "batch"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_equal_returns_have_scores_of_zero(score, dtype):
    """Also where the order of a sum makes a difference in the last places."""
    actor = make_actor(dtype=dtype)
    batch = sample(actor, 2, 3, 4)
    orders = torch.tensor([[0, 1, 2, 3], [0, 2, 1, 3], [0, 3, 1, 2]])
    rewards = torch.tensor([0.1, 0.2, 0.6, 0.9], dtype=dtype)
    batch["next", "reward"] = rewards[orders].unsqueeze(-1).expand(2, 3, 4, 1)
    loss = GRPOLoss(actor, score=score)
    assert len(loss._read(batch).returns.unique()) > 1
    assert (loss._read(batch).scores == 0).all()
    assert loss(batch)["loss_actor"] == 0


# -------------------------------------------------------------------------------------------- ECPO


@pytest.mark.parametrize("masked", [False, True], ids=["whole", "masked"])
@pytest.mark.parametrize(
    ("score", "of_scores", "tau_prime"),
    [("group", 1.0, 0.2), ("batch", math.sqrt(2), 0.2 * math.sqrt(1.5))],
)
def test_matched_entropy_by_hand(score, of_scores, tau_prime, masked):
    """Two groups of two: scores of mean square 1/2 or 1, and 1/2 for G = 2; surprise of 4."""
    actor = make_actor()
    batch = sample(actor, 2, 2, 4)
    surprise = torch.tensor([[5.0, 1.0], [6.0, 2.0]]).double()
    batch["action_log_prob"] = -surprise.unsqueeze(-1).expand(2, 2, 4) / 4
    batch["next", "reward"].zero_()
    batch["next", "reward"][0, 1, 2] = 7.0
    scores = torch.tensor([[-of_scores, of_scores], [0.0, 0.0]]).double()
    log_prob = torch.stack([numbers(actor, group).log_prob for group in split(batch)])
    weights = ((scores + tau_prime * surprise) / (0.8 + tau_prime)).softmax(-1)
    if masked:
        batch = torch.cat([batch, batch[:, :1]], 1)
        mask = torch.tensor([True, True, False]).view(1, 3, 1).expand(2, 3, 4)
        batch["next", "reward"][:, 2] = torch.nan
        batch["action_log_prob"] = batch["action_log_prob"].where(mask, torch.nan)
        batch[MASK] = mask
    loss = ECPOLoss(actor, tau=0.8, tau_prime=0.4, entropy="matched", score=score).double()
    loss.tau, loss.tau_prime = 0.8, 0.4
    out = loss(batch)
    expected = -(weights * log_prob).sum(-1).mean()
    assert_close(out["loss_actor"], expected)
    assert_close(gradients(out["loss_actor"], actor), gradients(expected, actor))
    assert_close(out["max_weight"], weights.amax(-1).mean())


def test_reps_matches_the_entropy_as_ecpo_does():
    actor = make_actor()
    batch = pad(sample(actor, 5, 6, 4))
    options = {"entropy": "matched", "score": "group", "tau_prime": 0.3}
    names = ("loss_actor", "ESS", "max_weight")
    nats, out, ecpo = (
        loss.double()(batch).select(*names)
        for loss in (
            REPSLoss(actor, **options | {"entropy": "nats"}),
            REPSLoss(actor, **options),
            ECPOLoss(actor, tau=1.0, **options),
        )
    )
    assert_close(out, ecpo)
    assert (out["ESS"] - nats["ESS"]).abs() > 1e-3


@pytest.mark.parametrize("loss_class", [ECPOLoss, REPSLoss])
def test_returns_have_no_deviation_to_match(loss_class):
    with pytest.raises(ValueError, match=r"entropy='matched' needs .*'group' or 'batch', got"):
        loss_class(make_actor(), entropy="matched")


def at_the_target(weights):
    """Four actions, each drawn once by a uniform policy; a policy that is the target already."""
    actor = make_actor()
    batch = sample(actor, 4, 1)
    batch["observation"].zero_()
    batch["action"] = torch.arange(4).unsqueeze(-1)
    batch["action_log_prob"].fill_(0.25).log_()
    batch["next", "reward"] = weights.log().view(4, 1, 1)
    actor.module[0].module[0].bias.data.copy_(weights.log())  # type: ignore
    return actor, batch


def test_projection_reaches_the_minimum_of_the_cross_entropy():
    """Solved, the projection's loss is the entropy of the weights (a policy that can be them)."""
    weights = torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64)
    actor, batch = at_the_target(weights)
    loss = CASE.build(actor)
    loss.tau, loss.tau_prime = 1.0, 0.0
    value = loss(batch)["loss_actor"]
    assert_close(value, -(weights * weights.log()).sum())
    assert max(g.abs().max() for g in gradients(value, actor)) < 1e-12


@pytest.mark.parametrize("delayed", [False, True], ids=["recorded", "delayed"])
def test_control_variate(delayed):
    """Each weight less the self-normalised ratio of the policy to the sampler."""
    reference, lag = (make_actor(), 0.1) if delayed else (None, 0.0)
    loss, actor, batch = problem(CASE, lag=lag, control_variate=True, delay_actor=delayed)
    if reference is not None:
        move(reference, lag)
    expected = []
    for group in split(batch):
        n = numbers(actor, group, reference)
        _, weights = CASE.formula(n, **CASE.temperatures)
        ratios = normalise((n.log_prob - n.behaviour).exp()).detach()
        expected.append(-((weights - ratios) * n.log_prob).sum())
    value = loss(batch)["loss_actor"]
    assert_close(value, torch.stack(expected).mean())
    assert_close(gradients(value, actor), gradients(torch.stack(expected).mean(), actor))


# --------------------------------------------------------------------------------------------- PMD


@pytest.mark.parametrize(
    "loss_class",
    [
        *[partial(PMDLoss, tau=tau) for tau in (0.1, 1.0, 10.0)],
        *[partial(SquaredPMDLoss, tau=tau) for tau in (0.1, 1.0, 10.0)],
        partial(MENTLoss, tau=0.0),
        DrGRPOLoss,
        partial(DrGRPOLoss, ratio="trajectory"),
    ],
    ids=str,
)
def test_reinforce_at_the_reference(loss_class):
    """PMD and its regression at theta = reference, tau' = 0, for any tau; MENT without an entropy
    term; the first step of Dr.GRPO.

    The group's mean is the baseline, which a constant added to all returns does not change.
    """
    actor = make_actor()
    batch = pad(sample(actor, 2, 3, 4))
    expected = torch.stack([reinforce(numbers(actor, group)) for group in split(batch)]).mean()
    loss = loss_class(actor).double()
    got = gradients(loss(batch)["loss_actor"], actor)
    assert_close(got, gradients(expected, actor))
    batch["next", "reward"][..., 0, 0] += 5.0
    assert_close(got, gradients(loss(batch)["loss_actor"], actor))


def test_entropy_term_at_the_reference_is_ments():
    """At theta = reference, PMD+entropy is MENT with tau = tau'."""
    actor = make_actor()
    batch = pad(sample(actor, 2, 3, 4))
    pmd = CASES["pmd"].build(actor)
    ment = MENTLoss(actor).double()
    ment.tau = pmd.tau_prime.item()
    got = gradients(pmd(batch)["loss_actor"], actor)
    assert_close(got, gradients(ment(batch)["loss_actor"], actor))


def test_large_tau_pulls_back_to_the_reference():
    """Away from the reference a step on PMD with a large tau reduces the divergence."""
    actor = make_actor()
    batch = sample(actor, 8, 64, 1)
    move(actor)
    loss = PMDLoss(actor, tau=100.0).double()
    before = loss(batch)
    before["loss_actor"].backward()
    torch.optim.SGD(loss.parameters(), lr=1e-3).step()
    assert loss(batch)["kl_reference_policy"] < before["kl_reference_policy"]


# -------------------------------------------------------------------------------------------- UREX


def test_policy_gradient_plus_tau_times_the_mean_seeking_projection():
    """The second part is ECPO's at tau = 0, tau' = UREX's tau, with the group's mean taken off."""
    actor = make_actor()
    batch = pad(sample(actor, 2, 3, 4))
    urex = CASES["urex"].build(actor)
    tau = urex.tau.item()
    policy_gradient = MENTLoss(actor, tau=0.0).double()
    mean_seeking = ECPOLoss(actor, tau=0.0, tau_prime=1.0, control_variate=True).double()
    mean_seeking.tau_prime = tau
    parts = policy_gradient(batch)["loss_actor"] + tau * mean_seeking(batch)["loss_actor"]
    out = urex(batch)
    assert_close(gradients(out["loss_actor"], actor), gradients(parts, actor))
    assert_close(out["ESS"], mean_seeking(batch)["ESS"])


# -------------------------------------------------------------------------------------------- MENT


def test_entropy_alone():
    """Equal returns: improbable trajectories are made more probable."""
    actor = make_actor()
    batch = sample(actor, 2, 16, 4)
    batch["next", "reward"].zero_()
    loss = MENTLoss(actor, tau=1.0).double()
    before = loss(batch)
    before["loss_actor"].backward()
    torch.optim.SGD(loss.parameters(), lr=1e-2).step()
    assert loss(batch)["entropy"] > before["entropy"]


# ------------------------------------------------------------------------- RLOO, GRPO, TPO, Kimi


@pytest.mark.parametrize("tau", [0.0, 0.3])
@pytest.mark.parametrize("masked", [(), (1,)])
def test_rloo_is_ment_times_k_over_k_minus_1(tau, masked):
    """K is the number of trajectories that are there."""
    actor = make_actor()
    batch = pad(sample(actor, 2, 4, 4), masked=masked)
    rloo, ment = (
        loss(actor, tau=tau, reduction="none").double()(batch)["loss_actor"]
        for loss in (RLOOLoss, MENTLoss)
    )
    assert_close(rloo, ment * torch.tensor([3 / 2 if masked else 4 / 3, 4 / 3]).double())


OPTIONS = [
    ("grpo", {"score": "return"}),
    ("grpo", {"aggregation": "prompt_sum", "score": "return"}),
    ("grpo", {"aggregation": "token_mean", "clip_epsilon": (0.05, 0.3)}),
    ("grpo", {"ratio": "trajectory", "clip_epsilon": (0.02, 0.03)}),
    ("grpo", {"ratio": "trajectory", "aggregation": "token_mean"}),
    ("tpo", {"score": "return"}),
    ("tpo", {"length_norm": True}),
    ("squared_pmd", {"normaliser": "soft"}),
]


@pytest.mark.parametrize(("name", "options"), OPTIONS, ids=str)
@pytest.mark.parametrize("delayed", [False, True], ids=["recorded", "delayed"])
def test_options_are_their_formula(name, options, delayed):
    """Value and gradient of each option that has not been a default so far."""
    case = replace(CASES[name], options=CASES[name].options | options)
    loss, actor, batch = problem(case, lag=0.1 * delayed, delay_actor=delayed)
    reference = [make_actor()] if delayed else []
    for each in reference:
        move(each, 0.1)
    expected = expected_losses(case, actor, batch, *reference).mean()
    out = loss(batch)
    assert_close(out["loss_actor"], expected)
    assert_close(gradients(out["loss_actor"], actor), gradients(expected, actor))
    if name == "grpo":
        assert 0 < out["clip_fraction"] < 1


@pytest.mark.parametrize("score", ["group", "return"])
def test_tpo_has_ecpos_weights_with_the_entropy_term_of_the_other_sign(score):
    """tau' / (tau + tau') = -1; and its sampler is taken for uniform in the control variate."""
    case = replace(CASES["tpo"], options={"score": score, "length_norm": False})
    loss, actor, batch = problem(case)
    [eta] = case.temperatures.values()
    tau, tau_prime = 2 * eta, -eta
    parts, sizes = [], []
    for n in (numbers(actor, group) for group in split(batch)):
        log_weights = (scores(n, score) - tau_prime * n.reference) / (tau + tau_prime)
        uniform = torch.zeros_like(n.reference)
        ecpo = mean_seeking_projection(n.log_prob, log_weights, control_log_prob=uniform)
        parts.append(ecpo.loss)
        sizes.append(1 / ecpo.weights.square().sum())
    out = loss(batch)
    assert_close(out["ESS"], torch.stack(sizes).mean())
    got = gradients(out["loss_actor"], actor)
    assert_close(got, gradients(torch.stack(parts).mean(), actor))


@pytest.mark.parametrize("normaliser", ["mean", "soft"])
def test_squared_pmd_is_zero_at_its_target_with_the_soft_normaliser(normaliser):
    """With the mean return it is 0 only where the lift is small."""
    actor, batch = at_the_target(torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64))
    loss = SquaredPMDLoss(actor, tau=1.0, normaliser=normaliser).double()
    assert (loss(batch)["loss_actor"].item() < 1e-20) is (normaliser == "soft")


@pytest.mark.parametrize(
    ("clip_epsilon", "message"),
    [(-0.1, "got -0.1"), ((0.2, -0.1), "got .0.2"), (1.0, "got 1.0"), ((1.0, 0.2), "< 1 downw")],
)
def test_clip_epsilon_is_checked(clip_epsilon, message):
    with pytest.raises(ValueError, match=f"clip_epsilon must be >= 0.*{message}"):
        GRPOLoss(make_actor(), clip_epsilon=clip_epsilon)


# -------------------------------------------------------------------------------------------- REPS


@pytest.mark.parametrize(
    ("epsilon", "tau_prime", "padded"), [(0.05, 0.0, True), (0.3, 0.2, False), (0.6, 0.0, True)]
)
def test_reps_finds_the_temperature_of_its_bound(epsilon, tau_prime, padded):
    """The gradient is that of the dual; where it is 0, the lift's mean length is epsilon nats."""
    actor = make_actor()
    batch = sample(actor, 5, 6, 4)
    batch = pad(batch) if padded else batch
    groups = [numbers(actor, group) for group in split(batch)]
    loss = REPSLoss(actor, epsilon=epsilon, tau_prime=tau_prime).double()
    loss.tau_prime = tau_prime
    for step in range(60):
        out = loss(batch)
        (slope,) = torch.autograd.grad(out["loss_tau"], loss.log_tau)
        assert_close(slope, epsilon - out["kl_target_reference"])
        if not step:
            tau = torch.tensor(1.0).double().requires_grad_()
            values = [
                soft_value_estimate(n.returns, n.reference, tau=tau, tau_prime=tau_prime)
                for n in groups
            ]
            dual = tau * epsilon + torch.stack(values).mean()
            assert_close(slope, *torch.autograd.grad(dual, tau))
        loss.log_tau.data -= slope / (2 * epsilon)
    assert_close(out["kl_target_reference"].item(), epsilon, atol=1e-6, rtol=0)
    assert_close(out["tau"], loss.temperature("tau"))
    ecpo = ECPOLoss(actor).double()
    ecpo.tau, ecpo.tau_prime = out["tau"], tau_prime
    names = ("loss_actor", "ESS", "max_weight")
    assert_close(out.select(*names), ecpo(batch).select(*names))


@pytest.mark.parametrize("name", CASES)
def test_a_subclass_may_learn_a_temperature(name):
    """Where it stands at the scheduled value, the losses are those of the member."""
    case = CASES[name]
    temperature = next(iter(case.temperatures))

    class Learning(case.loss):
        def __init__(self, *networks, **options):
            super().__init__(*networks, **options)
            self.learn(temperature, case.temperatures[temperature])

    loss, actor, batch = problem(case)
    learning = Learning(actor, **case.temperatures, **case.options).double()
    assert_close(learning(batch), loss(batch), rtol=1e-6, atol=1e-6)


def test_reps_measures_from_the_reference():
    """Also where another policy drew the trajectories."""
    actor, reference = make_actor(), make_actor()
    batch = sample(actor, 2, 6, 4)
    move(actor, 0.3)
    move(reference, 0.3)
    loss = REPSLoss(actor, delay_actor=True).double()
    HardUpdate(loss, value_network_update_interval=1)
    expected = []
    for n in (numbers(actor, group, reference) for group in split(batch)):
        base = normalise((n.reference - n.behaviour).exp())
        weights = normalise(base * n.returns.exp())
        expected.append((weights * (weights / base).log()).sum())
    assert_close(loss(batch)["kl_target_reference"], torch.stack(expected).mean())


def test_what_reps_refuses():
    with pytest.raises(ValueError, match="epsilon must be above 0, in nats, got 0"):
        REPSLoss(make_actor(), epsilon=0.0)
    with pytest.raises(
        ValueError, match=r"epsilon must be below log K = 1\.1, .* of 3 goes, got 1\.2"
    ):
        REPSLoss(make_actor(), epsilon=1.2)(sample(make_actor(), 2, 3, 4))
    with pytest.raises(ValueError, match=r"epsilon must be below log K = 0\.693"):
        REPSLoss(make_actor(), epsilon=1.0)(pad(sample(make_actor(), 2, 3, 4), masked=(0,)))
    with pytest.raises(ValueError, match=r"tau must be in \(0, inf\), got 0"):
        REPSLoss(make_actor(), tau=0.0, tau_prime=0.1)
    loss = REPSLoss(make_actor())
    with pytest.raises(AttributeError, match="tau is learned"):
        loss.tau = 0.5
