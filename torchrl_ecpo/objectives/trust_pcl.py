"""Trust-PCL: path consistency with a value network."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tensordict import TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_ecpo._torchrl import holding
from torchrl_ecpo.checks import (
    UNREADABLE,
    as_float,
    check_count,
    check_network,
    get_entry,
    unreadable,
)
from torchrl_ecpo.functional import Surrogate, masked_mean, path_consistency
from torchrl_ecpo.llm.completions import is_language_model
from torchrl_ecpo.objectives.trajectory import LiftProjectLoss, Steps, TrajectoryGroups


class TrustPCLLoss(LiftProjectLoss):
    r"""Trust-PCL: the objective that ECPO lifts by, as a condition on every path of d steps.

    Nachum, Norouzi, Xu and Schuurmans, "Trust-PCL: An Off-Policy Trust Region Method for Continuous
    Control", ICLR 2018. The policy that maximises E r - tau KL(pi, pi_bar) + tau' H(pi) (Eq. 4 of
    the paper of ECPO) and its soft value V (Eq. 8) are those for which

    .. math::
        C_t = -V(s_t) + \gamma^d V(s_{t+d}) + \sum_{i<d} \gamma^i \left[ r_{t+i}
            - (\tau + \tau') \log \pi(a_{t+i}|s_{t+i}) + \tau \log \bar\pi(a_{t+i}|s_{t+i}) \right]

    is 0, whoever took the path: :func:`~torchrl_ecpo.functional.path_consistency`. Both learn from
    the mean of :math:`C_t^2 / 2` over the real steps, ``loss_actor`` and ``loss_value``, whose
    values are equal and whose gradients are each network's own. The paper's lambda is tau, and its
    tau is tau_prime.

    Trajectories are not compared, so those of a group may be of any problem instances (leave
    ``"group"`` out then). The value after a trajectory's last real step is 0, also at a time limit,
    as the return of the other losses ends there.

    Args:
        actor_network: a policy with ``get_dist``, see :class:`TrajectoryGroupLoss`.
        value_network: reads the observation, writes ``"state_value"`` ``[*G, K, T, 1]``.

    Keyword Args:
        tau: temperature of the divergence from the reference policy, in the unit of the return.
            Default: 0.5, as :class:`~torchrl_ecpo.ECPOLoss`.
        tau_prime: temperature of the entropy. Default: 0.01, likewise.
        gamma: discount of what is to come, from 0 to 1. Default: 1, as for the other losses.
        n_steps: d, the length of the paths, which end with the trajectory. Default: 10, the
            paper's.
        delay_actor: if True (default, the paper's), the reference policy is the loss's own delayed
            copy of the actor, to be moved by an updater; if False, the policy that drew the
            trajectories.
        reduction: ``"mean"`` over groups (default), ``"sum"`` or ``"none"``.

    Raises:
        TypeError: also if ``value_network`` is no TensorDictModule.
        ValueError: also for a gamma or n_steps out of range; when called, for a value that is not
            one finite number for each step.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torch.distributions import Categorical
        >>> from torchrl.modules import ProbabilisticActor, ValueOperator
        >>> from torchrl_ecpo import PolyakAverage
        >>> network = TensorDictModule(torch.nn.Linear(2, 6), ["observation"], ["logits"])
        >>> actor = ProbabilisticActor(network, ["logits"], distribution_class=Categorical)
        >>> value = ValueOperator(torch.nn.Linear(2, 1), in_keys=["observation"])
        >>> loss_module = TrustPCLLoss(actor, value)
        >>> updater = PolyakAverage(loss_module, "actor_network", weight=0.01)
        >>> losses = loss_module(TensorDict({
        ...     "observation": torch.randn(3, 4, 5, 2),
        ...     "action": torch.randint(6, (3, 4, 5)),
        ...     "next": {"reward": torch.rand(3, 4, 5, 1)},
        ... }, batch_size=[3, 4, 5]))
        >>> (losses["loss_actor"] + losses["loss_value"]).backward()
        >>> updater.step()
    """

    losses = ("loss_value",)
    metrics = ("state_value",)
    reads_steps = True
    least_group = 1

    @dataclass
    class _AcceptedKeys(LiftProjectLoss._AcceptedKeys):
        """Those of the other losses, and what the value network writes.

        Attributes:
            value: ``[*G, K, T, 1]``. Defaults to ``"state_value"``.
        """

        value: NestedKey = "state_value"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    value_network: TensorDictModule
    value_network_params: TensorDictParams
    target_value_network_params: TensorDictParams  # TorchRL warns of a network without it

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        value_network: TensorDictModule,
        *,
        tau: float = 0.5,
        tau_prime: float = 0.01,
        gamma: float = 1.0,
        n_steps: int = 10,
        delay_actor: bool = True,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        if is_language_model(actor_network):
            raise TypeError(
                "TrustPCLLoss reads values of states, which completions of a language model have "
                "not. Take another loss over groups, such as ECPOLoss."
            )
        super().__init__(
            actor_network,
            tau=tau,
            tau_prime=tau_prime,
            delay_actor=delay_actor,
            reduction=reduction,
        )
        check_network("value_network", value_network)
        self.gamma = as_float("gamma", gamma, "[0, 1]")
        self.n_steps = check_count("n_steps", n_steps)
        self.convert_to_functional(value_network, "value_network")
        self.further_in_keys = tuple(value_network.in_keys)

    def surrogate(self, groups: TrajectoryGroups) -> Surrogate:
        """Half the squared residual, once for the policy and once for the values."""
        steps = groups.steps
        values = self._values(steps)
        losses = [
            self._mean(self._residual(steps, log_prob, value).square() / 2, steps)
            for log_prob, value in (
                (steps.log_prob, values.detach()),
                (steps.log_prob.detach(), values),
            )
        ]
        found = {"state_value": self._mean(values, steps)}
        return Surrogate(losses[0], None, {"loss_value": losses[1]}, found)

    def _residual(self, steps: Steps, log_prob: Tensor, values: Tensor) -> Tensor:
        return path_consistency(
            steps.rewards,
            log_prob,
            steps.reference_log_prob,
            values,
            tau=self.temperature("tau"),
            tau_prime=self.tau_prime,
            gamma=self.gamma,
            n_steps=self.n_steps,
            mask=steps.mask,
        )

    def _values(self, steps: Steps) -> Tensor:
        """V ``[*G, K, T]`` of each step's state; carries the gradient."""
        assert steps.inputs is not None
        inputs, keys = steps.inputs.copy(), self.value_network.in_keys
        with holding(self.value_network, self.value_network_params):
            try:
                outputs = self.value_network(inputs)
            except UNREADABLE as error:
                raise unreadable("value network", steps.inputs, keys, error) from error
        key = self.tensor_keys.value
        values = get_entry(outputs, key)
        if values.shape != (*steps.inputs.shape, 1):
            raise ValueError(
                f"The value {key!r} must be one number for each step, of shape "
                f"{(*steps.inputs.shape, 1)}, got {tuple(values.shape)}."
            )
        values = values.reshape(steps.rewards.shape).to(steps.rewards.dtype)
        self._check_values({f"value {key!r}": values})
        return values

    @staticmethod
    def _mean(values: Tensor, steps: Steps) -> Tensor:
        """Over the real steps of each group, ``[*G]``."""
        mask = None if steps.mask is None else steps.mask.flatten(-2)
        return masked_mean(values.flatten(-2), mask=mask)
