"""Which delayed network follows which network, how, and when.

A loss keeps *delayed* copies of some of its networks as ``target_<network>_params``: the reference
policy that ECPO lifts, the value network behind a soft-Q target. TorchRL's
:class:`~torchrl.objectives.SoftUpdate` and :class:`~torchrl.objectives.HardUpdate` take all of them
at once; the updaters here take the networks they are given by name, so that one loss can have a
reference policy that is replaced every N calls and a value target that is averaged:

>>> import torch
>>> from tensordict.nn import TensorDictModule
>>> from torchrl.modules import ValueOperator
>>> from torchrl.objectives import DDPGLoss
>>> actor = TensorDictModule(
...     torch.nn.Linear(3, 1), in_keys=["observation"], out_keys=["action"]
... )
>>> critic = ValueOperator(torch.nn.Linear(3, 1), in_keys=["observation"])
>>> loss = DDPGLoss(actor, critic, delay_actor=True)
>>> updater = UpdaterSequence(
...     PeriodicCopy(loss, "actor_network", interval=100),
...     PolyakAverage(loss, "value_network", tau=0.005),
... )
>>> updater.step()  # once after each optimizer step

Checkpoints
-----------
The values of the delayed networks travel with the loss's state dict, the progress of an updater
with its own. Building an updater copies the networks, so build first and load both afterwards.
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

from torch import Tensor
from torchrl.objectives import LossModule, TargetNetUpdater

__all__ = ["PeriodicCopy", "PolyakAverage", "UpdaterSequence"]


class _NetworkUpdater(TargetNetUpdater):
    """A :class:`~torchrl.objectives.TargetNetUpdater` of the named networks of a loss only.

    A subclass says in ``_step`` what one call does to one tensor. Overridden from TorchRL's class:

    - the constructor, which takes every target of the loss and marks all of them as updated;
    - ``init_`` and ``step``, which keep their own collection of the tensors that required a
      gradient when it was built: buffers (the statistics of a normalisation layer), frozen layers
      and parameters shared with another network would stay behind. Reading the loss at each call
      leaves out nothing, and there is no collection that could go stale.
    """

    def __init__(self, loss_module: LossModule, *networks: str) -> None:
        if not isinstance(loss_module, LossModule):
            raise ValueError(
                f"loss_module must be a torchrl LossModule, got {type(loss_module).__name__}."
            )
        self.loss_module = loss_module
        self.networks = _delayed_networks(loss_module, networks)
        self._source_names = [f"{name}_params" for name in self.networks]
        self._target_names = [f"target_{name}_params" for name in self.networks]
        self.initialized = False

        # The loss warns whenever a target is read that has no updater: our own are marked before
        # `init_` reads them, and nobody else's, so that a forgotten network is still reported.
        associated = loss_module._has_update_associated
        before = dict(associated)
        associated.update(dict.fromkeys(self.networks, True))
        try:
            self.init_()
        except Exception:
            associated.update(before)
            raise

    def init_(self) -> None:
        """Copies the networks into their delayed parameters, now.

        The constructor does this. Call it again whenever the two should start level once more, for
        instance after ``loss.reset_parameters_recursive()``, which draws different values for a
        network and for its delayed copy; unlike TorchRL's updaters, this does not warn.

        Raises:
            RuntimeError: if delayed parameters require a gradient.
        """
        for source, target in self._pairs():
            target.data.copy_(source.data)
        self.initialized = True

    def step(self) -> None:
        """Updates the delayed parameters, in place and without a graph.

        Raises:
            RuntimeError: if the updater is not initialised, or if delayed parameters require a
                gradient.
        """
        self._check_initialized()
        for source, target in self._pairs():
            self._step(source.data, target.data)

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restores the progress that ``state_dict()`` returned.

        Raises:
            ValueError: if the entries are not those of this kind of updater.
        """
        expected = self.state_dict()
        if state_dict.keys() != expected.keys():
            raise ValueError(
                f"The state of a {type(self).__name__} has the entries {sorted(expected)}, got "
                f"{sorted(state_dict)}: was it saved by another kind of updater?"
            )
        super().load_state_dict(state_dict)

    def _pairs(self) -> Iterator[tuple[Tensor, Tensor]]:
        """Yields every (network tensor, delayed tensor), buffers included."""
        for source_name, target_name in zip(self._source_names, self._target_names, strict=True):
            sources = getattr(self.loss_module, source_name)
            for key, target in getattr(self.loss_module, target_name).items(True, True):
                if target.requires_grad:
                    raise RuntimeError(
                        f"{target_name} requires a gradient ({key!r}): delayed parameters must "
                        "stay buffers. Use them through "
                        "`params.to_module(net, preserve_module_state=False)`."
                    )
                yield sources.get(key), target

    def _check_initialized(self) -> None:
        if not self.initialized:
            raise RuntimeError(f"Call {type(self).__name__}.init_() before step().")

    def _extra_repr(self) -> str:
        raise NotImplementedError

    def __repr__(self) -> str:
        networks = ", ".join(map(repr, self.networks))
        loss = type(self.loss_module).__name__
        return f"{type(self).__name__}({loss}, {networks}, {self._extra_repr()})"


class PeriodicCopy(_NetworkUpdater):
    """Replaces delayed networks by the networks themselves on every N-th call.

    This is how a reference policy moves from one lift to the next: it stands still for N gradient
    steps while the policy is projected, then becomes the policy. Calls N, 2N, 3N, ... copy, exactly
    (TorchRL's ``HardUpdate(loss, value_network_update_interval=N)`` copies on every (N+1)-th call).
    Parameters and buffers are copied in place; dtype, device and absence of gradients stay.

    Args:
        loss_module: any loss with delayed networks.
        *networks: the networks to follow, by their names in the loss, such as ``"actor_network"``.
            Default: all delayed networks of the loss.

    Keyword Args:
        interval: number N of calls of :meth:`step` from one copy to the next.

    Attributes:
        counter: calls since the last copy, from 0 to N - 1; part of the state dict.

    Raises:
        ValueError: if ``loss_module`` is no LossModule, if a network is unknown, not delayed or
            named twice, or if ``interval`` is not a positive int.

    Examples:
        >>> import torch
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.modules import ValueOperator
        >>> from torchrl.objectives import DDPGLoss
        >>> actor = TensorDictModule(
        ...     torch.nn.Linear(3, 1), in_keys=["observation"], out_keys=["action"]
        ... )
        >>> critic = ValueOperator(torch.nn.Linear(3, 1), in_keys=["observation"])
        >>> loss = DDPGLoss(actor, critic, delay_actor=True, delay_value=False)
        >>> updater = PeriodicCopy(loss, "actor_network", interval=3)
        >>> updater
        PeriodicCopy(DDPGLoss, 'actor_network', interval=3)
        >>> reference = loss.target_actor_network_params
        >>> _ = torch.nn.init.ones_(actor.module.bias)
        >>> for call in range(1, 4):
        ...     updater.step()
        ...     print(call, (reference["module", "bias"] == actor.module.bias).all().item())
        1 False
        2 False
        3 True
    """

    def __init__(self, loss_module: LossModule, *networks: str, interval: int) -> None:
        if not isinstance(interval, int) or isinstance(interval, bool) or interval < 1:
            raise ValueError(
                f"interval must be a positive int (the number of calls from one copy to the "
                f"next), got {interval!r}."
            )
        self.interval = interval
        self.counter = 0
        super().__init__(loss_module, *networks)

    def init_(self) -> None:
        """Copies the networks into their delayed parameters, now, and counts anew from here."""
        super().init_()
        self.counter = 0

    def step(self) -> None:
        """Counts one call; copies on every ``interval``-th.

        Raises:
            RuntimeError: as for :meth:`init_`, or if the updater is not initialised.
        """
        self._check_initialized()
        self.counter += 1
        # Not "==": a run may be resumed with an interval shorter than the count it was saved with.
        if self.counter >= self.interval:
            super().step()
            self.counter = 0

    def _step(self, p_source: Tensor, p_target: Tensor) -> None:
        p_target.copy_(p_source)

    def _extra_repr(self) -> str:
        return f"interval={self.interval}"


class PolyakAverage(_NetworkUpdater):
    """Moves delayed networks a fraction of the way towards the networks on every call.

    ``delayed <- (1 - tau) * delayed + tau * network``, in place, for parameters and floating point
    buffers; integer and boolean buffers (a layer's batch counter) are copied.

    Args:
        loss_module: any loss with delayed networks.
        *networks: the networks to follow, by their names in the loss, such as
            ``"qvalue_network"``. Default: all delayed networks of the loss.

    Keyword Args:
        tau: weight of the network, in (0, 1]; ``1 - eps`` of TorchRL's ``SoftUpdate``. This is not
            the temperature of the losses. Default: 0.005, the value of TD3 and of SAC's published
            implementations, and ours for actor-critic runs.

    Raises:
        ValueError: if ``loss_module`` is no LossModule, if a network is unknown, not delayed or
            named twice, or if ``tau`` is not in (0, 1].

    Examples:
        >>> import torch
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.modules import ValueOperator
        >>> from torchrl.objectives import DDPGLoss
        >>> actor = TensorDictModule(
        ...     torch.nn.Linear(3, 1), in_keys=["observation"], out_keys=["action"]
        ... )
        >>> critic = ValueOperator(torch.nn.Linear(3, 1), in_keys=["observation"])
        >>> _ = torch.nn.init.zeros_(critic.module.bias)
        >>> loss = DDPGLoss(actor, critic)
        >>> updater = PolyakAverage(loss, "value_network", tau=0.25)
        >>> _ = torch.nn.init.ones_(critic.module.bias)
        >>> updater.step()
        >>> loss.target_value_network_params["module", "bias"].item()
        0.25
        >>> updater.step()
        >>> loss.target_value_network_params["module", "bias"].item()
        0.4375
    """

    def __init__(self, loss_module: LossModule, *networks: str, tau: float = 0.005) -> None:
        if not 0 < tau <= 1:
            raise ValueError(
                f"tau must be in (0, 1] (the weight of the network in the average), got {tau!r}."
            )
        self.tau = tau
        super().__init__(loss_module, *networks)

    def _step(self, p_source: Tensor, p_target: Tensor) -> None:
        if p_target.is_floating_point():
            p_target.lerp_(p_source, self.tau)
        else:
            p_target.copy_(p_source)

    def _extra_repr(self) -> str:
        return f"tau={self.tau}"


class UpdaterSequence(TargetNetUpdater):
    """Several updaters of one loss, used as one.

    It is a :class:`~torchrl.objectives.TargetNetUpdater` itself, so it goes wherever TorchRL takes
    one (a trainer's ``target_net_updater``, :class:`~torchrl.trainers.TargetNetUpdaterHook`), and
    into another sequence. A delayed network of the loss that has no updater at all may be updated
    by hand, so it is not refused, but a warning names it; TorchRL's own warning then follows at
    each call of the loss.

    Args:
        *updaters: updaters of one and the same loss, no two of which update the same network.

    Warns:
        UserWarning: if a delayed network of the loss has no updater.

    Raises:
        ValueError: if there are no updaters, if one of them is no TargetNetUpdater, if they belong
            to different losses, or if two of them update the same network.

    Examples:
        >>> import torch
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.modules import ValueOperator
        >>> from torchrl.objectives import DDPGLoss
        >>> actor = TensorDictModule(
        ...     torch.nn.Linear(3, 1), in_keys=["observation"], out_keys=["action"]
        ... )
        >>> critic = ValueOperator(torch.nn.Linear(3, 1), in_keys=["observation"])
        >>> loss = DDPGLoss(actor, critic, delay_actor=True)
        >>> updater = UpdaterSequence(
        ...     PeriodicCopy(loss, "actor_network", interval=100),
        ...     PolyakAverage(loss, "value_network"),
        ... )
        >>> updater
        UpdaterSequence(
            PeriodicCopy(DDPGLoss, 'actor_network', interval=100),
            PolyakAverage(DDPGLoss, 'value_network', tau=0.005),
        )
        >>> updater.step()
        >>> updater.state_dict()
        {'updaters': [{'initialized': True, 'counter': 1}, {'initialized': True}]}
    """

    def __init__(self, *updaters: TargetNetUpdater) -> None:
        _check_composable(updaters)
        self.updaters = updaters
        self.loss_module = updaters[0].loss_module
        self._source_names = [name for updater in updaters for name in updater._source_names]
        self._target_names = [name for updater in updaters for name in updater._target_names]
        associated = self.loss_module._has_update_associated
        if forgotten := [name for name, has_updater in associated.items() if not has_updater]:
            warnings.warn(
                f"No updater follows the delayed network(s) {forgotten} of "
                f"{type(self.loss_module).__name__}: unless they are updated by hand, they keep "
                "their first values. Add an updater for them to the sequence.",
                category=UserWarning,
                stacklevel=2,
            )

    @property
    def initialized(self) -> bool:
        """Whether every updater is initialised."""
        return all(updater.initialized for updater in self.updaters)

    def init_(self) -> None:
        """Initialises every updater, see :meth:`PeriodicCopy.init_`."""
        for updater in self.updaters:
            updater.init_()

    def step(self) -> None:
        """One step of every updater."""
        for updater in self.updaters:
            updater.step()

    def state_dict(self) -> dict[str, Any]:
        """Returns the progress of every updater, in order."""
        return {"updaters": [updater.state_dict() for updater in self.updaters]}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restores the progress that :meth:`state_dict` returned.

        Raises:
            ValueError: if it is not the state of a sequence of as many updaters of the same kinds.
        """
        states = state_dict.get("updaters", [])
        if state_dict.keys() != {"updaters"} or len(states) != len(self.updaters):
            raise ValueError(
                f"The state of this UpdaterSequence has one entry, 'updaters', with "
                f"{len(self.updaters)} states, got {dict(state_dict)}."
            )
        for updater, state in zip(self.updaters, states, strict=True):
            updater.load_state_dict(state)

    def __repr__(self) -> str:
        lines = "".join(f"    {updater!r},\n" for updater in self.updaters)
        return f"{type(self).__name__}(\n{lines})"


def _delayed_networks(loss_module: LossModule, networks: tuple[str, ...]) -> tuple[str, ...]:
    """Checks the names against the delayed networks of the loss; all of them if none is named."""
    loss = type(loss_module).__name__
    known = list(loss_module._has_update_associated)
    delayed = [name for name in known if f"target_{name}_params" in loss_module._modules]
    if not networks and not delayed:
        raise ValueError(f"{loss} has no delayed networks. {_how_to_delay(loss_module)}")
    for name in networks:
        if name not in known:
            raise ValueError(f"{loss} has no network {name!r}; its delayed networks: {delayed}.")
        if name not in delayed:
            raise ValueError(
                f"The network {name!r} of {loss} has no delayed parameters. "
                f"{_how_to_delay(loss_module, name)}"
            )
        if networks.count(name) > 1:
            raise ValueError(f"The network {name!r} is named twice.")
    return networks or tuple(delayed)


def _how_to_delay(loss_module: LossModule, network: str | None = None) -> str:
    """Names the ``delay_*`` flag of a network where it has one, else the flags that there are."""
    flags = [
        name
        for base in type(loss_module).__mro__
        for name in inspect.signature(base.__init__).parameters
        if name.startswith("delay_")
    ]
    if network is not None:
        flag = f"delay_{network.removesuffix('_network')}"
        flags = [flag] if flag in flags else flags
    if not flags:
        return "This loss has no delay_* flag."
    return "Build the loss with " + " or ".join(f"{f}=True" for f in dict.fromkeys(flags)) + "."


def _check_composable(updaters: tuple[TargetNetUpdater, ...]) -> None:
    if not updaters:
        raise ValueError("UpdaterSequence needs at least one updater.")
    owners: dict[str, TargetNetUpdater] = {}
    for updater in updaters:
        if not isinstance(updater, TargetNetUpdater):
            raise ValueError(
                f"UpdaterSequence takes TargetNetUpdaters, got {type(updater).__name__}."
            )
        if updater.loss_module is not updaters[0].loss_module:
            raise ValueError(
                "The updaters of an UpdaterSequence must belong to one loss: build a sequence for "
                "each loss."
            )
        for target in updater._target_names:
            if target in owners:
                raise ValueError(
                    f"{target} has two updaters, {type(owners[target]).__name__} and "
                    f"{type(updater).__name__}: name each network in one of them only."
                )
            owners[target] = updater
