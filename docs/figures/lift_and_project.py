"""Draw lift and project where both can be seen: one action, and a policy of two parameters.

    python docs/figures/lift_and_project.py

The action is a number; its reward has a low hill at -1.5 and a higher one at 2. The policy is a
Gaussian: mean and standard deviation are its two parameters. All sums are over a fine grid of
actions, so nothing is sampled and nothing is approximate but the grid.
"""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor
from torch.distributions import Normal

from torchrl_ecpo.functional import (
    lifted_log_weights,
    mean_seeking_projection,
    mode_seeking_projection,
    self_normalised_weights,
)

ACTIONS = torch.linspace(-5.0, 5.0, 401)
STEP = (ACTIONS[1] - ACTIONS[0]).item()
REWARD = 0.7 * (-(ACTIONS + 1.5).square() / 0.6).exp() + (-(ACTIONS - 2.0).square() / 0.6).exp()
# As if every action of the grid had been drawn once.
GRID_LOG_PROB = torch.full_like(ACTIONS, -math.log(STEP * len(ACTIONS)))
REFERENCE = (-0.8, 1.2)  # mean and standard deviation
TAU, TAU_PRIME = 0.25, 0.05
NUM_LIFTS, NUM_STEPS, LEARNING_RATE = 30, 40, 0.02
MEAN_SEEKING, MODE_SEEKING = "mean-seeking KL(target, policy)", "mode-seeking KL(policy, target)"
COLOURS = {MEAN_SEEKING: "#0072B2", MODE_SEEKING: "#D55E00"}
FOLDER = Path(__file__).parent


def log_density(loc: float | Tensor, scale: float | Tensor) -> Tensor:
    """Of the policy, at each action of the grid."""
    return Normal(loc, scale).log_prob(ACTIONS)


def target_density(reference: Tensor, tau: float, tau_prime: float) -> Tensor:
    """The lifted policy, Eq. 5."""
    log_weights = lifted_log_weights(REWARD, reference, tau=tau, tau_prime=tau_prime)
    return self_normalised_weights(reference + log_weights) / STEP


def divergence_to(target: Tensor, log_policy: Tensor, projection: str) -> Tensor:
    """KL between target and policy, in the direction of the projection."""
    if projection == MEAN_SEEKING:
        return (target * (target.log() - log_policy)).sum(-1) * STEP
    return (log_policy.exp() * (log_policy - target.log())).sum(-1) * STEP


def project(
    start: tuple[float, float], reference: Tensor, projection: str, num_steps: int
) -> list[tuple[float, float]]:
    """Mean and standard deviation of the policy before and after each gradient step."""
    loc = torch.tensor(start[0], requires_grad=True)
    log_scale = torch.tensor(math.log(start[1]), requires_grad=True)
    optimizer = torch.optim.Adam([loc, log_scale], LEARNING_RATE)
    lift = lifted_log_weights(REWARD, reference, tau=TAU, tau_prime=TAU_PRIME)
    path = [start]
    for _ in range(num_steps):
        log_prob = log_density(loc, log_scale.exp())
        if projection == MEAN_SEEKING:
            loss, _ = mean_seeking_projection(log_prob, lift + reference - GRID_LOG_PROB)
        else:
            loss, _ = mode_seeking_projection(
                log_prob, reference, lift, behaviour_log_prob=GRID_LOG_PROB
            )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        path.append((loc.item(), log_scale.exp().item()))
    return path


def draw_lift() -> Figure:
    """Targets of one reference policy at several temperatures."""
    reference = log_density(*REFERENCE)
    figure, panels = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained", sharey=True)
    settings = (
        ("smaller tau: further from the reference", [(1.0, 0.0), (0.3, 0.0), (0.15, 0.0)]),
        ("larger share of tau': the reference fades", [(0.3, 0.0), (0.15, 0.15), (0.0, 0.3)]),
    )
    for panel, (title, temperatures) in zip(panels, settings, strict=True):
        panel.fill_between(ACTIONS, REWARD, color="0.9", label="reward")
        panel.plot(ACTIONS, reference.exp(), color="black", linestyle=":", label="reference")
        for (tau, tau_prime), colour in zip(
            temperatures, ("#56B4E9", "#0072B2", "#CC79A7"), strict=True
        ):
            label = f"target, tau {tau:g}, tau' {tau_prime:g}"
            panel.plot(
                ACTIONS, target_density(reference, tau, tau_prime), color=colour, label=label
            )
        panel.set(title=title, xlabel="action", ylim=(0, 1.7))
        panel.legend(frameon=False, fontsize="small")
    panels[0].set_ylabel("reward, or density")
    return figure


def draw_projections() -> Figure:
    """Both divergences over the two parameters, and where gradient descent on them ends."""
    reference = log_density(*REFERENCE)
    target = target_density(reference, TAU, TAU_PRIME)
    figure, panels = plt.subplots(1, 3, figsize=(12, 3.4), layout="constrained")
    panels[0].fill_between(ACTIONS, target, color="0.85", label="target")
    panels[0].plot(ACTIONS, reference.exp(), color="black", linestyle=":", label="reference")
    for panel, projection in zip(panels[1:], COLOURS, strict=True):
        path = project(REFERENCE, reference, projection, num_steps=400)
        draw_landscape(panel, target, projection, path)
        label = f"{projection.split()[0]} projection"
        panels[0].plot(
            ACTIONS, log_density(*path[-1]).exp(), color=COLOURS[projection], label=label
        )
    panels[0].set(xlabel="action", ylabel="density", ylim=(0, None))
    panels[0].legend(frameon=False, fontsize="small")
    return figure


def draw_landscape(
    panel: Axes, target: Tensor, projection: str, path: list[tuple[float, float]]
) -> None:
    """Contours of a divergence over mean and standard deviation, and the path of the policy."""
    locs, scales = torch.linspace(-3.0, 3.5, 66), torch.linspace(0.25, 2.5, 46)
    log_policies = Normal(locs[:, None], scales[:, None, None]).log_prob(ACTIONS)
    heights = divergence_to(target, log_policies, projection)
    panel.contourf(locs, scales, heights.clamp_max(4.0).sqrt(), levels=12, cmap="Greys")
    means, deviations = zip(*path, strict=True)
    panel.plot(means, deviations, color=COLOURS[projection])
    panel.plot(means[0], deviations[0], "o", color="black", fillstyle="none")
    panel.plot(means[-1], deviations[-1], "o", color=COLOURS[projection])
    panel.set(title=projection, xlabel="mean", ylabel="standard deviation")


def draw_iterations() -> Figure:
    """The policy over many lifts, each followed by a few gradient steps."""
    figure, panels = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained", sharey=True)
    for panel, projection in zip(panels, COLOURS, strict=True):
        policy, densities = REFERENCE, []
        for _ in range(NUM_LIFTS):
            reference = log_density(*policy)
            densities.append(reference.exp())
            policy = project(policy, reference, projection, NUM_STEPS)[-1]
        panel.imshow(
            torch.stack(densities, 1).sqrt(),
            origin="lower",
            aspect="auto",
            cmap="Greys",
            vmax=1.0,
            extent=(0, NUM_LIFTS, ACTIONS[0].item(), ACTIONS[-1].item()),
        )
        for hill, name in ((-1.5, "low hill"), (2.0, "high hill")):
            panel.axhline(hill, color=COLOURS[projection], linewidth=0.8, linestyle=":")
            panel.text(NUM_LIFTS, hill + 0.4, name, ha="right", color=COLOURS[projection])
        panel.set(title=projection, xlabel="lifts")
    panels[0].set_ylabel("action")
    return figure


def main() -> None:
    """Write the pictures beside this file."""
    plt.rcParams["svg.hashsalt"] = "torchrl_ecpo"
    for name, draw in (
        ("lift", draw_lift),
        ("projections", draw_projections),
        ("iterations", draw_iterations),
    ):
        draw().savefig(FOLDER / f"{name}.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
