"""Group relative policy optimisation, and those that differ from it by an option."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor

from torchrl_ecpo.checks import as_float, check_choice
from torchrl_ecpo.functional import (
    Surrogate,
    centred,
    clipped_gain,
    divergence_penalty,
    masked_mean,
    self_normalised_weights,
)
from torchrl_ecpo.objectives.trajectory import Score, TrajectoryGroupLoss, TrajectoryGroups


class GRPOLoss(TrajectoryGroupLoss):
    r"""GRPO: clipped ratios of the steps, weighed by the scores of their trajectories.

    Shao et al., "DeepSeekMath", 2024. Options make it Dr.GRPO (Liu et al. 2025: ``score="return"``,
    ``aggregation="prompt_sum"``), DAPO (Yu et al. 2025: ``clip_epsilon=(0.2, 0.28)``,
    ``aggregation="token_mean"``) or GSPO (Zheng et al. 2025: ``ratio="trajectory"``,
    ``clip_epsilon=(3e-4, 4e-4)``). Over K trajectories of T_k steps,

    .. math::
        L(\theta) = -\frac1K \sum_k \frac{c_k}{T_k} \sum_t \left[
            \min\left(\rho_{kt} A_k, \; \mathrm{clip}(\rho_{kt}, 1 - \epsilon_{low},
            1 + \epsilon_{high}) A_k\right) - \beta \left(e^{d_{kt}} - d_{kt} - 1\right) \right]

    with rho the ratio to the policy that drew the trajectories, and d = log pi_bar - log pi.

    Args:
        actor_network: a policy with ``get_dist``, see :class:`TrajectoryGroupLoss`.

    Keyword Args:
        clip_epsilon: epsilon, or (epsilon_low, epsilon_high). Defaults to 0.2 (PPO).
        score: A, see :class:`TrajectoryGroupLoss`. Defaults to ``"group"``; of ``"return"`` the
            group's mean is taken off, too.
        aggregation: ``"prompt_mean"`` (default), the mean over a trajectory's steps, c = 1;
            ``"prompt_sum"``, their sum, c = T; ``"token_mean"``, over all steps, c = T / mean T.
        ratio: of each ``"step"`` (default), or of the ``"trajectory"``: their geometric mean.
        kl_to_ref_coeff: beta, scheduled as a temperature. Defaults to 0; DeepSeekMath has 0.04.
        delay_actor: if True, the reference is the loss's own delayed copy of the actor. Defaults
            to False: it is the policy that drew the trajectories.
        reduction: ``"mean"`` over groups (default), ``"sum"`` or ``"none"``.

    Raises:
        ValueError: for a `clip_epsilon` below 0 or, downwards, of 1 or more, for an unknown
            `aggregation` or `ratio`, and as :class:`TrajectoryGroupLoss`.

    Examples:
        >>> from torchrl_ecpo.envs import BanditEnv
        >>> from torchrl_ecpo.modules import make_softmax_policy
        >>> env = BanditEnv(num_actions=6, num_groups=3, group_size=4)
        >>> actor = make_softmax_policy(env.features)
        >>> loss_module = GRPOLoss(actor, clip_epsilon=(0.2, 0.28))
        >>> loss = loss_module(env.rollout(1, actor))  # 3 groups of 4 trajectories of 1 step
        >>> loss["loss_actor"].backward(); loss["clip_fraction"]  # at first all ratios are 1
        tensor(0.)
    """

    metrics = ("ESS", "max_weight", "clip_fraction")
    kl_to_ref_coeff: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        clip_epsilon: float | tuple[float, float] = 0.2,
        score: Score = "group",
        aggregation: Literal["prompt_mean", "prompt_sum", "token_mean"] = "prompt_mean",
        ratio: Literal["step", "trajectory"] = "step",
        kl_to_ref_coeff: float = 0.0,
        delay_actor: bool = False,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        super().__init__(
            actor_network,
            temperatures={"kl_to_ref_coeff": kl_to_ref_coeff},
            allow_zero=True,
            score=score,
            delay_actor=delay_actor,
            reduction=reduction,
        )
        is_pair = isinstance(clip_epsilon, Sequence) and len(clip_epsilon) == 2
        pair: Any = clip_epsilon if is_pair else (clip_epsilon, clip_epsilon)
        self.clip_low, self.clip_high = (as_float("clip_epsilon", each) for each in pair)
        if not (0 <= self.clip_low < 1 and 0 <= self.clip_high < math.inf):
            raise ValueError(f"clip_epsilon must be >= 0, and < 1 downwards, got {clip_epsilon}.")
        self.aggregation, self.ratio = aggregation, ratio
        check_choice("aggregation", aggregation, ("prompt_mean", "prompt_sum", "token_mean"))
        check_choice("ratio", ratio, ("step", "trajectory"))

    def surrogate(self, groups: TrajectoryGroups) -> Surrogate:
        """The clipped gain less the penalty; the weights are the trajectories' ratios."""
        steps, mask = groups.steps, groups.mask
        scores = groups.scores
        advantage = (centred(scores, mask=mask) if self.score == "return" else scores).unsqueeze(-1)
        log_ratio = steps.log_prob - steps.behaviour_log_prob
        if self.ratio == "trajectory":
            log_ratio = masked_mean(log_ratio, mask=steps.mask, keepdim=True).expand_as(log_ratio)
        gain, is_cut = clipped_gain(
            log_ratio, advantage, clip_low=self.clip_low, clip_high=self.clip_high
        )
        penalty = divergence_penalty(steps.log_prob, steps.reference_log_prob)
        loss = masked_mean(self.temperature("kl_to_ref_coeff") * penalty - gain, mask=steps.mask)
        if self.aggregation != "prompt_mean":
            loss = loss * groups.num_steps
        if self.aggregation == "token_mean":
            mean_steps = masked_mean(groups.num_steps, mask=mask, keepdim=True)
            loss = loss / mean_steps.clamp_min(1)
        ratios = groups.log_prob.detach() - groups.behaviour_log_prob
        fraction = masked_mean(is_cut.to(loss.dtype), mask=steps.mask)
        metrics = {"clip_fraction": masked_mean(fraction, mask=mask)}
        weights = self_normalised_weights(ratios, mask=mask)
        return Surrogate(masked_mean(loss, mask=mask), weights, metrics=metrics)
