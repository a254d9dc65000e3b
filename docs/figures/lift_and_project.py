"""Draw lift and project where both can be seen: one action, and a policy of two parameters.

    python docs/figures/lift_and_project.py

The action is a number; its reward has a low hill at -1.5 and a higher one at 2. The policy is a
Gaussian: mean and standard deviation are its two parameters. All sums are over a fine grid of
actions, so nothing is sampled and nothing is approximate but the grid.
"""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib
import torch
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from matplotlib.figure import Figure
from torch import Tensor
from torch.distributions import Normal

from torchrl_ecpo.experiment.figures import (
    COLOURS,
    METHOD_COLOURS,
    NEUTRAL,
    STYLE,
    save_figure,
)
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
OF_PROJECTION = {
    MEAN_SEEKING: METHOD_COLOURS["meanseeking"],
    MODE_SEEKING: METHOD_COLOURS["modeseeking"],
}
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
            surrogate = mean_seeking_projection(log_prob, lift + reference - GRID_LOG_PROB)
        else:
            surrogate = mode_seeking_projection(
                log_prob, reference, lift, behaviour_log_prob=GRID_LOG_PROB
            )
        optimizer.zero_grad()
        surrogate.loss.backward()
        optimizer.step()
        path.append((loc.item(), log_scale.exp().item()))
    return path


def draw_lift() -> Figure:
    """Targets of one reference policy at several temperatures."""
    reference = log_density(*REFERENCE)
    figure = Figure(figsize=(7.6, 3.2), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    settings = (
        ("smaller τ: further from the reference", [(1.0, 0.0), (0.3, 0.0), (0.15, 0.0)]),
        ("larger share of τ\N{PRIME}: the reference fades", [(0.3, 0.0), (0.15, 0.15), (0.0, 0.3)]),
    )
    colours, entries = iter(COLOURS), {}
    for panel, (title, temperatures) in zip(panels, settings, strict=True):
        entries["reward"] = panel.fill_between(ACTIONS, REWARD, color=NEUTRAL, alpha=0.3, lw=0)
        (entries["reference"],) = panel.plot(ACTIONS, reference.exp(), color=NEUTRAL, ls=":")
        for tau, tau_prime in temperatures:
            label = f"τ = {tau:g}, τ\N{PRIME} = {tau_prime:g}"
            target = target_density(reference, tau, tau_prime)
            colour = entries[label].get_color() if label in entries else next(colours)
            (entries[label],) = panel.plot(ACTIONS, target, color=colour)
        panel.set(title=title, xlabel="action", ylim=(0, 1.1))
    panels[0].set_ylabel("reward, or density")
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=4)
    return figure


def draw_projections() -> Figure:
    """Both divergences over the two parameters, and where gradient descent on them ends."""
    reference = log_density(*REFERENCE)
    target = target_density(reference, TAU, TAU_PRIME)
    figure = Figure(figsize=(7.6, 2.9), layout="constrained")
    panels = figure.subplots(1, 3)
    panels[0].fill_between(ACTIONS, target, color=NEUTRAL, alpha=0.4, lw=0, label="target")
    panels[0].plot(ACTIONS, reference.exp(), color=NEUTRAL, linestyle=":", label="reference")
    for panel, projection in zip(panels[1:], OF_PROJECTION, strict=True):
        path = project(REFERENCE, reference, projection, num_steps=400)
        draw_landscape(panel, target, projection, path)
        label = f"{projection.split()[0]} projection"
        panels[0].plot(
            ACTIONS, log_density(*path[-1]).exp(), color=OF_PROJECTION[projection], label=label
        )
    panels[0].set(xlabel="action", ylabel="density", ylim=(0, None))
    figure.legend(loc="outside lower center", ncols=4)
    return figure


def fading(colour: str) -> LinearSegmentedColormap:
    """From nothing to a colour, which fits light and dark pages."""
    return LinearSegmentedColormap.from_list(colour, [(*to_rgb(colour), a) for a in (0.0, 1.0)])


def draw_landscape(
    panel: Axes, target: Tensor, projection: str, path: list[tuple[float, float]]
) -> None:
    """Contours of a divergence over mean and standard deviation, and the path of the policy."""
    locs, scales = torch.linspace(-3.0, 3.5, 66), torch.linspace(0.25, 2.5, 46)
    log_policies = Normal(locs[:, None], scales[:, None, None]).log_prob(ACTIONS)
    heights = divergence_to(target, log_policies, projection)
    panel.contourf(locs, scales, heights.clamp_max(4.0).sqrt(), levels=12, cmap=fading(NEUTRAL))
    means, deviations = zip(*path, strict=True)
    panel.plot(means, deviations, color=OF_PROJECTION[projection])
    panel.plot(means[0], deviations[0], "o", color=NEUTRAL, fillstyle="none")
    panel.plot(means[-1], deviations[-1], "o", color=OF_PROJECTION[projection])
    panel.set(title=projection, xlabel="mean", ylabel="standard deviation")


def draw_iterations() -> Figure:
    """The policy over many lifts, each followed by a few gradient steps."""
    figure = Figure(figsize=(7.6, 2.6), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for panel, projection in zip(panels, OF_PROJECTION, strict=True):
        policy, densities = REFERENCE, []
        for _ in range(NUM_LIFTS):
            reference = log_density(*policy)
            densities.append(reference.exp())
            policy = project(policy, reference, projection, NUM_STEPS)[-1]
        panel.imshow(
            torch.stack(densities, 1).sqrt(),
            origin="lower",
            aspect="auto",
            cmap=fading(OF_PROJECTION[projection]),
            vmax=1.0,
            extent=(0, NUM_LIFTS, ACTIONS[0].item(), ACTIONS[-1].item()),
        )
        for hill, name in ((-1.5, "low hill"), (2.0, "high hill")):
            panel.axhline(hill, color=OF_PROJECTION[projection], linewidth=0.8, linestyle=":")
            panel.text(NUM_LIFTS, hill + 0.6, name, ha="right", color=OF_PROJECTION[projection])
        panel.set(title=projection, xlabel="lifts")
    panels[0].set_ylabel("action")
    return figure


@matplotlib.rc_context(STYLE)
def main() -> None:
    """Write the pictures beside this file."""
    for name, draw in (
        ("lift", draw_lift),
        ("projections", draw_projections),
        ("iterations", draw_iterations),
    ):
        save_figure(draw(), FOLDER / f"{name}.svg")


if __name__ == "__main__":
    main()
