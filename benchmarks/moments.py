"""Error of ECAC's two estimates of the lift's moments, by samples and by the gradient of Q.

    python benchmarks/moments.py --csv benchmarks/results/moments.csv

Where the moments are known: a standard Gaussian reference in A dimensions, and at each state
another quadratic f = Q + tau' log|da/du|, with random gradient and positive semidefinite Hessian,
at tau = 1 and tau' = 1/4. Such a lift is one of some 0.08 nats for each dimension, the script's
``target_kl``. 200 batches of 128 states, over each of which the coefficient c is pooled.

An evaluation is one of Q, or its gradient: four samples with gradients cost what eight without do.
Errors are in units of the reference's deviation and variance. The bias of the mean is along the
true one, in per cent of it; that of the variance is in per cent of the true one.
"""

from __future__ import annotations

from typing import Any

import torch
from common import read_arguments, write_csv
from torch import Tensor

from torchrl_ecpo.functional import lifted_gaussian_moments

TAU, TAU_PRIME = 1.0, 0.25
NUM_BATCHES, NUM_STATES = 200, 128
SIZES = (1, 6, 17)
CASES = (("samples", 8), ("gradient", 4), ("samples", 16), ("gradient", 8))


def of_samples(x: Tensor, log_weights: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and centred variance, as ``centred_gaussian_projection`` has them."""
    weights = log_weights.softmax(0).unsqueeze(-1)
    mean = (weights * x).sum(0)
    return mean, (weights * (x - mean).square()).sum(0) / (1 - weights.square().sum(0))


def measure(estimator: str, m: int, size: int) -> dict[str, Any]:
    """A row of the table."""
    torch.manual_seed(0)
    sums = torch.zeros(6, dtype=torch.float64)
    for _ in range(NUM_BATCHES):
        gradient = 0.42 * torch.randn(NUM_STATES, size, dtype=torch.float64)
        root = torch.randn(NUM_STATES, size, size, dtype=torch.float64) * (0.5 / size) ** 0.5
        hessian = root @ root.mT
        covariance = torch.linalg.inv(TAU * torch.eye(size, dtype=torch.float64) + hessian)
        mean = torch.einsum("bij,bj->bi", covariance, gradient)
        variance = (TAU + TAU_PRIME) * covariance.diagonal(dim1=-2, dim2=-1)

        x = torch.randn(m, NUM_STATES, size, dtype=torch.float64)
        if estimator == "gradient":
            x = torch.cat([x[: m // 2], -x[: m // 2]])
        curved = torch.einsum("bij,mbj->mbi", hessian, x)
        score = (gradient * x - curved * x / 2).sum(-1)
        log_weights = (score + TAU_PRIME * x.square().sum(-1) / 2) / (TAU + TAU_PRIME)
        if estimator == "gradient":
            moments = lifted_gaussian_moments(
                x, gradient - curved, log_weights, tau=TAU, tau_prime=TAU_PRIME, sample_dim=0
            )
        else:
            moments = of_samples(x, log_weights)
        of_mean, of_variance = moments[0] - mean, moments[1] - variance
        values = (of_mean * mean, mean**2, of_variance, variance, of_mean**2, of_variance**2)
        sums += torch.stack([value.mean() for value in values])
    along, length, narrower, width, *squares = (sums / NUM_BATCHES).tolist()
    return {
        "dimensions": size,
        "estimator": estimator,
        "M": m,
        "evaluations": m * (2 if estimator == "gradient" else 1),
        "mean_error": squares[0] ** 0.5,
        "mean_bias_percent": 100 * along / length,
        "variance_error": squares[1] ** 0.5,
        "variance_bias_percent": 100 * narrower / width,
    }


def main() -> None:
    """Print the table, and write it where it is to go."""
    path = read_arguments(__doc__).csv
    rows = [measure(*case, size) for size in SIZES for case in CASES]
    for row in rows:
        print(*(f"{x:.3f}" if isinstance(x, float) else x for x in row.values()))
    write_csv(path, rows)


if __name__ == "__main__":
    main()
