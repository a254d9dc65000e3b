"""What long completions do to the weights of a group: effective sample sizes by length.

    python benchmarks/llm_lengths.py --csv llm_lengths.csv

No model: the log-probability of a token has mean -0.5 and deviation 1, a group has 8 completions of
half to full length, of which 40 % are right (reward 1, else 0). The mean over 2,000 groups.

- lift: the weights of ECPOLoss at tau = 0.5, for several ways to weigh the entropy.
- ratio: the weights softmax(log pi - log pi_bar) once the policy has moved, by a log-ratio of
  deviation 0.05 per token: what the control variate subtracts, and corrections for older samples.
  Truncated at 2, or to the power of 1 / length.
"""

from __future__ import annotations

import torch
from common import read_arguments, write_csv
from torch import Tensor

from torchrl_ecpo.functional import (
    effective_sample_size,
    lifted_log_weights,
    matched_temperature,
    self_normalised_weights,
    standardised,
)

LENGTHS, GROUPS, K, TAU, MOVED = (16, 128, 1024), 2_000, 8, 0.5, 0.05


def log_weights(length: int) -> dict[str, Tensor]:
    """Log-weights ``[G, K]`` by what makes them."""
    lengths = (length * (0.5 + 0.5 * torch.rand(GROUPS, K))).round()
    log_prob = -0.5 * lengths + lengths.sqrt() * torch.randn(GROUPS, K)
    returns = (torch.rand(GROUPS, K) < 0.4).float()
    scores = standardised(returns)
    matched = matched_temperature(0.05, scores, log_prob)
    ratio = MOVED * lengths.sqrt() * torch.randn(GROUPS, K) - MOVED**2 * lengths / 2
    return {
        "lift, tau'=0": returns / TAU,
        "lift, tau'=0.01": lifted_log_weights(returns, log_prob, tau=TAU, tau_prime=0.01),
        "lift, score=group, tau'=0": scores / TAU,
        "lift, score=group, tau'=0.01": lifted_log_weights(
            scores, log_prob, tau=TAU, tau_prime=0.01
        ),
        "lift, score=group, entropy=matched, tau'=0.05": lifted_log_weights(
            scores, log_prob, tau=TAU, tau_prime=matched
        ),
        "ratio": ratio,
        "ratio, truncated": ratio.clamp_max(torch.tensor(2.0).log()),
        "ratio, by length": ratio / lengths,
    }


def main() -> None:
    arguments = read_arguments(__doc__)
    torch.manual_seed(0)
    table: dict[str, dict[str, object]] = {}
    for length in LENGTHS:
        for name, values in log_weights(length).items():
            ess = effective_sample_size(self_normalised_weights(values)).mean().item()
            table.setdefault(name, {"weights": name})[f"ess_{length}"] = round(ess, 2)
    for row in table.values():
        print(*row.values(), sep="\t")
    write_csv(arguments.csv, table.values())


if __name__ == "__main__":
    main()
