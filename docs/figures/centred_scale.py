"""Draw what the centred scale does where the answer is known.

    python docs/figures/centred_scale.py

One action, Q(a) = -(a - g)^2 with a goal g that moves, as the best action does while Q is learned,
and a Gaussian policy that is lifted anew after every gradient step, as in an actor-critic, from
M = 8 samples at each of 128 states. The lift's fixed point is a Gaussian of variance tau' / 2.
"""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib
import torch
from matplotlib.figure import Figure
from torch.distributions import Normal

from torchrl_ecpo.experiment.figures import METHOD_COLOURS, NEUTRAL, STYLE, save_figure
from torchrl_ecpo.functional import (
    centred_gaussian_projection,
    lifted_log_weights,
    mean_seeking_projection,
)

TAU, TAU_PRIME = 0.5, 0.1
NUM_STATES, NUM_SAMPLES, NUM_LIFTS, LEARNING_RATE = 128, 8, 1000, 0.01
PERIOD = 300  # lifts, in which the goal goes from -1 to 1 and back


def scales(projection: str) -> list[float]:
    """The policy's standard deviation after each lift and step."""
    torch.manual_seed(0)
    loc, log_scale = torch.zeros(1, requires_grad=True), torch.zeros(1, requires_grad=True)
    optimizer = torch.optim.SGD([loc, log_scale], LEARNING_RATE)
    history = []
    for step in range(NUM_LIFTS):
        goal = math.sin(2 * math.pi * step / PERIOD)
        policy = Normal(loc, log_scale.exp())
        action = policy.sample(torch.Size([NUM_SAMPLES, NUM_STATES]))
        log_prob = policy.log_prob(action).squeeze(-1)
        score = -(action - goal).square().squeeze(-1)
        lift = lifted_log_weights(score, log_prob.detach(), tau=TAU, tau_prime=TAU_PRIME)
        if projection == "centred":
            parameters = (x.expand(NUM_STATES, 1) for x in (loc, log_scale.exp()))
            loss = centred_gaussian_projection(*parameters, action, lift, sample_dim=0).loss
        else:
            loss = mean_seeking_projection(log_prob, lift, sample_dim=0).loss
        optimizer.zero_grad()
        loss.mean().backward()
        optimizer.step()
        history.append(log_scale.exp().item())
    return history


@matplotlib.rc_context(STYLE)
def main() -> None:
    """Write the picture beside this file."""
    figure = Figure(figsize=(7.6, 2.8), layout="constrained")
    axes = figure.subplots()
    axes.plot(scales("paper"), color=METHOD_COLOURS["eq11"], label="Eq. 11 to the letter")
    axes.plot(scales("centred"), color=METHOD_COLOURS["centredscale"], label="centred scale")
    axes.axhline(
        math.sqrt(TAU_PRIME / 2), color=NEUTRAL, linestyle=":", label="fixed point of the lift"
    )
    axes.set(
        xlabel="lifts, one gradient step each",
        ylabel="standard deviation of the policy",
        yscale="log",
        yticks=(0.2, 0.5, 1.0),
        yticklabels=("0.2", "0.5", "1"),
    )
    axes.minorticks_off()
    figure.legend(loc="outside right center")
    save_figure(figure, Path(__file__).with_suffix(".svg"))


if __name__ == "__main__":
    main()
