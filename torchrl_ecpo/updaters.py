"""Which delayed network follows which network, how, and when.

A loss keeps *delayed* copies of some of its networks as ``target_<network>_params``: the reference
policy that ECPO lifts, the value network behind a soft-Q target. TorchRL's
:class:`~torchrl.objectives.SoftUpdate` and :class:`~torchrl.objectives.HardUpdate` take all of them
at once. The updaters here take the networks they are given by name, so that one loss can have a
reference policy that is replaced every N calls and a value target that is averaged:

>>> import torch
>>> from tensordict.nn import TensorDictModule
>>> from torchrl.modules import ValueOperator
>>> from torchrl.objectives import DDPGLoss
>>> policy = torch.nn.Linear(3, 1)
>>> critic = torch.nn.Linear(3, 1)
>>> loss = DDPGLoss(
...     TensorDictModule(policy, in_keys=["observation"], out_keys=["action"]),
...     ValueOperator(critic, in_keys=["observation"]),
...     delay_actor=True,
... )
>>> for network in (policy, critic):
...     _ = torch.nn.init.zeros_(network.bias)
>>> updater = UpdaterSequence(
...     PeriodicCopy(loss, "actor_network", interval=2),
...     PolyakAverage(loss, "value_network", weight=0.25),
... )
>>> for network in (policy, critic):
...     _ = torch.nn.init.ones_(network.bias)
>>> reference = loss.target_actor_network_params["module", "bias"]
>>> target = loss.target_value_network_params["module", "bias"]
>>> for _ in range(2):  # once after each optimizer step
...     updater.step()
...     print(reference.item(), target.item())
0.0 0.25
1.0 0.4375
>>> updater
UpdaterSequence(
    PeriodicCopy(DDPGLoss, 'actor_network', interval=2),
    PolyakAverage(DDPGLoss, 'value_network', weight=0.25),
)
>>> updater.state_dict()
{'updaters': [{'initialized': True, 'counter': 0}, {'initialized': True}]}

Checkpoints
-----------
The values of the delayed networks travel with the loss's state dict, the progress of an updater
with its own. Building an updater copies the networks, so build first and load both afterwards.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor
from torchrl.objectives import LossModule, TargetNetUpdater

from torchrl_ecpo._torchrl import networks_with_updater
from torchrl_ecpo.checks import as_float, check_count, check_flag, check_kind, is_captured

__all__ = ["PeriodicCopy", "PolyakAverage", "UpdaterSequence"]


class _NetworkUpdater(TargetNetUpdater):
    """An updater of the named networks of a loss only.

    A subclass says in ``_update`` what one call does to one tensor. TorchRL's constructor takes
    every target of the loss. Its ``init_`` and ``step`` keep a collection of the tensors that
    required a gradient when it was built: buffers (the statistics of a normalisation layer), frozen
    layers and parameters shared with another network would stay behind. Ours read the loss at each
    call.
    """

    option: str
    """The name of the subclass's option, for ``repr``."""

    def __init__(self, loss_module: LossModule, *networks: str) -> None:
        check_kind("loss_module", loss_module, LossModule)
        self.loss_module = loss_module
        self.networks = _delayed_networks(loss_module, networks)
        with warnings.catch_warnings():
            # A loss warns when a target is read that no updater follows yet.
            warnings.simplefilter("ignore")
            self.init_()
        networks_with_updater(loss_module).update(dict.fromkeys(self.networks, True))

    def init_(self) -> None:
        """Copies the networks into their delayed parameters, now.

        The constructor does this. Call it again after ``loss.reset_parameters_recursive()``, which
        draws different values for a network and for its delayed copy.
        """
        for _, source, target in self._pairs():
            target.copy_(source)
        self.initialized = True

    def step(self) -> None:
        """Updates the delayed parameters, in place and without a graph.

        Raises:
            RuntimeError: if the updater is not initialised, or if delayed parameters require a
                gradient.
        """
        if not self.initialized:
            raise RuntimeError(f"Call {type(self).__name__}.init_() before step().")
        if self._is_due():
            for name, source, target in self._pairs():
                self._update(name, source, target)

    def _update(self, name: str, source: Tensor, target: Tensor) -> None:
        """What one call does to one delayed tensor: makes it equal to that of the network."""
        target.copy_(source)

    def _is_due(self) -> bool:
        """Whether this call does anything."""
        return True

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restores the progress that ``state_dict()`` returned.

        Raises:
            ValueError: if the entries are not those of this kind of updater.
        """
        self._check_state(state_dict)
        if "counter" in state_dict:
            self.counter = int(state_dict["counter"])
        self.initialized = bool(state_dict["initialized"])

    def _check_state(self, state_dict: Mapping[str, Any]) -> None:
        """Refuse a state of another kind, before anything is loaded."""
        expected = self.state_dict()
        if state_dict.keys() != expected.keys():
            raise ValueError(
                f"The state of a {type(self).__name__} has the entries {sorted(expected)}, got "
                f"{sorted(state_dict)}: was it saved by another kind of updater?"
            )
        check_flag("initialized", state_dict["initialized"])
        if "counter" in expected:
            check_count("counter", state_dict["counter"], least=0)

    def _pairs(self) -> Iterator[tuple[str, Tensor, Tensor]]:
        """Yields the name and the data of every network tensor and its copy, buffers included."""
        for network in self.networks:
            delayed = f"target_{network}_params"
            sources = getattr(self.loss_module, f"{network}_params")
            for key, target in getattr(self.loss_module, delayed).items(True, True):
                if target.requires_grad:
                    raise RuntimeError(
                        f"{delayed} requires a gradient ({key!r}): delayed parameters must stay "
                        "buffers. Use them through "
                        "`params.to_module(net, preserve_module_state=False)`."
                    )
                path = (key,) if isinstance(key, str) else key
                yield ".".join((network, *path)), sources.get(key).data, target.data

    def __repr__(self) -> str:
        arguments = [type(self.loss_module).__name__, *map(repr, self.networks)]
        arguments.append(f"{self.option}={getattr(self, self.option)}")
        return f"{type(self).__name__}({', '.join(arguments)})"


class PeriodicCopy(_NetworkUpdater):
    """Replaces delayed networks by the networks themselves on every N-th call.

    This is how a reference policy moves from one lift to the next: it stands still for N gradient
    steps while the policy is projected, then becomes the policy. Calls N, 2N, 3N, ... copy, exactly
    (TorchRL's ``HardUpdate(loss, value_network_update_interval=N)`` copies on every (N+1)-th call).
    Parameters and buffers are copied in place. There is an example at the head of
    :mod:`torchrl_ecpo.updaters`.

    Args:
        loss_module: any loss with delayed networks.
        *networks: the networks to follow, by their names in the loss, such as ``"actor_network"``.
            Default: all delayed networks of the loss.

    Keyword Args:
        interval: number N of calls of `step` from one copy to the next.

    Attributes:
        counter: calls since the last copy, from 0 to N - 1; part of the state dict.

    Raises:
        TypeError: if ``loss_module`` is no LossModule.
        ValueError: if a network is unknown, not delayed or named twice, or if
            ``interval`` is not a positive int.

    Examples:
        >>> from torchrl_ecpo import ECPOLoss
        >>> from torchrl_ecpo.envs import BanditEnv
        >>> from torchrl_ecpo.modules import make_softmax_policy
        >>> actor = make_softmax_policy(BanditEnv(num_actions=6).features)
        >>> loss_module = ECPOLoss(actor, delay_actor=True)
        >>> updater = PeriodicCopy(loss_module, "actor_network", interval=100)
        >>> updater.step()
        >>> updater.counter
        1
    """

    option = "interval"

    def __init__(self, loss_module: LossModule, *networks: str, interval: int) -> None:
        reason = ", the number of calls from one copy to the next"
        self.interval = check_count("interval", interval, reason=reason)
        self.counter = 0
        super().__init__(loss_module, *networks)

    def init_(self) -> None:
        """Copies the networks into their delayed parameters, now, and counts from 0 again."""
        super().init_()
        self.counter = 0

    def _is_due(self) -> bool:
        if self.interval > 1 and is_captured():
            raise RuntimeError(
                "PeriodicCopy counts its calls, which a CUDA graph would not replay: call step() "
                "outside of the graph."
            )
        self.counter += 1
        # Not "==": a run may be resumed with an interval shorter than the count it was saved with.
        if self.counter < self.interval:
            return False
        self.counter = 0
        return True


class PolyakAverage(_NetworkUpdater):
    """Moves delayed networks a fraction of the way towards the networks on every call.

    ``delayed <- (1 - weight) * delayed + weight * network``, in place, for parameters and floating
    point buffers; integer and boolean buffers (a layer's batch counter) are copied. The average of
    a network in half precision, where small steps would be rounded away, is kept in single
    precision, as part of the state dict. There is an example at the head of
    :mod:`torchrl_ecpo.updaters`.

    Args:
        loss_module: any loss with delayed networks.
        *networks: the networks to follow, by their names in the loss, such as
            ``"qvalue_network"``. Default: all delayed networks of the loss.

    Keyword Args:
        weight: of the network in the average, in (0, 1]; TorchRL's ``SoftUpdate`` calls it ``tau``.
            Default: 0.005, the value of TD3 and of SAC's published implementations, and ours for
            actor-critic runs.

    Raises:
        TypeError: if ``loss_module`` is no LossModule.
        ValueError: if a network is unknown, not delayed or named twice, or if
            ``weight`` is not in (0, 1].

    Examples:
        >>> from torchrl_ecpo import ECPOLoss
        >>> from torchrl_ecpo.envs import BanditEnv
        >>> from torchrl_ecpo.modules import make_softmax_policy
        >>> actor = make_softmax_policy(BanditEnv(num_actions=6).features)
        >>> loss_module = ECPOLoss(actor, delay_actor=True)
        >>> updater = PolyakAverage(loss_module, "actor_network", weight=0.01)
        >>> updater.step()
    """

    option = "weight"

    def __init__(self, loss_module: LossModule, *networks: str, weight: float = 0.005) -> None:
        self.weight = as_float("weight", weight, "(0, 1]")
        self._averages: dict[str, Tensor] = {}
        super().__init__(loss_module, *networks)

    def init_(self) -> None:
        """Copies the networks into their delayed parameters, now; averages begin there."""
        super().init_()
        self._averages.clear()

    def _update(self, name: str, source: Tensor, target: Tensor) -> None:
        if not target.is_floating_point():
            target.copy_(source)
        elif _is_half(target):
            self._averages[name] = self._average(name, target).lerp(source.float(), self.weight)
            target.copy_(self._averages[name])
        else:
            target.lerp_(source, self.weight)

    def _average(self, name: str, target: Tensor) -> Tensor:
        """In single precision; anew from the delayed tensor where somebody else has written it."""
        average = self._averages.get(name)
        if average is None:
            return target.float()
        average = average.to(target.device)
        return average.where(average.to(target.dtype) == target, target.float())

    def state_dict(self) -> dict[str, Any]:
        """Returns the progress: of networks in half precision, their averages in single."""
        pairs = [(name, target) for name, _, target in self._pairs() if _is_half(target)]
        averages = {name: self._average(name, target) for name, target in pairs}
        return super().state_dict() | ({"averages": averages} if averages else {})

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned.

        Raises:
            ValueError: if it is not the state of an updater of this kind and of these networks.
        """
        super().load_state_dict(state_dict)
        averages = state_dict.get("averages", {})
        self._averages = {name: average.detach().clone() for name, average in averages.items()}

    def _check_state(self, state_dict: Mapping[str, Any]) -> None:
        super()._check_state(state_dict)
        own, given = self.state_dict().get("averages", {}), state_dict.get("averages", {})
        check_kind("averages", given, Mapping)
        wrong = [n for n in own | given if n not in own or not _is_like(given.get(n), own[n])]
        if wrong:
            raise ValueError(
                f"The averages of {wrong} in the state are missing, not this updater's, or no "
                "finite single-precision numbers of its shapes: was it saved with other networks?"
            )


class UpdaterSequence(TargetNetUpdater):
    """Several updaters of one loss, used as one.

    It is a :class:`~torchrl.objectives.TargetNetUpdater` itself, so it goes wherever TorchRL takes
    one (a trainer's ``target_net_updater``, :class:`~torchrl.trainers.TargetNetUpdaterHook`), and
    into another sequence. There is an example at the head of :mod:`torchrl_ecpo.updaters`.

    Args:
        *updaters: updaters of one and the same loss, no two of which update the same network.

    Warns:
        UserWarning: if a delayed network of the loss has no updater; it may be updated by hand.

    Raises:
        ValueError: if there are no updaters, if one of them is no TargetNetUpdater, if they belong
            to different losses, or if two of them update the same network.

    Examples:
        >>> from torchrl_ecpo import ECPOLoss
        >>> from torchrl_ecpo.envs import BanditEnv
        >>> from torchrl_ecpo.modules import make_softmax_policy
        >>> actor = make_softmax_policy(BanditEnv(num_actions=6).features)
        >>> loss_module = ECPOLoss(actor, delay_actor=True)
        >>> UpdaterSequence(PeriodicCopy(loss_module, "actor_network", interval=100)).networks
        ('actor_network',)
    """

    def __init__(self, *updaters: TargetNetUpdater) -> None:
        owners = _owners(updaters)
        self.updaters = updaters
        self.networks = tuple(owners)
        self.loss_module = updaters[0].loss_module
        associated = networks_with_updater(self.loss_module)
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
            ValueError, TypeError: if it is not the state of a sequence of as many updaters of the
                same kinds.
        """
        states = state_dict.get("updaters", None)
        is_list = isinstance(states, (list, tuple)) and all(isinstance(x, Mapping) for x in states)
        if state_dict.keys() != {"updaters"} or not is_list or len(states) != len(self.updaters):
            raise ValueError(
                f"The state of this UpdaterSequence has one entry, 'updaters', with "
                f"{len(self.updaters)} states, got {dict(state_dict)}."
            )
        before = self.state_dict()["updaters"]
        try:
            for updater, state in zip(self.updaters, states, strict=True):
                updater.load_state_dict(state)
        except (ValueError, TypeError):  # the state as a whole is refused
            for updater, state in zip(self.updaters, before, strict=True):
                updater.load_state_dict(state)
            raise

    def __repr__(self) -> str:
        lines = "".join(f"    {updater!r},\n" for updater in self.updaters)
        return f"{type(self).__name__}(\n{lines})"


def _is_like(given: Any, own: Tensor) -> bool:
    """Whether it is a finite tensor of the same kind."""
    is_like = isinstance(given, Tensor) and (given.shape, given.dtype) == (own.shape, own.dtype)
    return is_like and bool(given.isfinite().all())


def _is_half(tensor: Tensor) -> bool:
    """Whether it has floating point numbers of less than single precision."""
    return tensor.is_floating_point() and tensor.dtype.itemsize < torch.float32.itemsize


def _delayed_networks(loss_module: LossModule, networks: tuple[str, ...] = ()) -> tuple[str, ...]:
    """Checks the names against the delayed networks of the loss; all of them if none is named."""
    children = dict(loss_module.named_children())
    known = networks_with_updater(loss_module)
    delayed = tuple(name for name in known if f"target_{name}_params" in children)
    others = [name for name in networks if name not in delayed]
    if others or not delayed:
        raise ValueError(
            f"No updater can follow {others or 'a network'} of {type(loss_module).__name__}: its "
            f"delayed networks are {list(delayed)}. A network is delayed by an argument of the "
            "loss, such as delay_actor=True or delay_value=True."
        )
    if len(set(networks)) < len(networks):
        raise ValueError(f"A network is named twice: {list(networks)}.")
    return networks or delayed


def _owners(updaters: tuple[TargetNetUpdater, ...]) -> dict[str, TargetNetUpdater]:
    """The updater of each network; refuses what is no sequence."""
    if not updaters:
        raise ValueError("UpdaterSequence needs updaters, at least one.")
    owners: dict[str, TargetNetUpdater] = {}
    for updater in updaters:
        if not isinstance(updater, TargetNetUpdater):
            raise ValueError(
                "The updaters of an UpdaterSequence must be TargetNetUpdaters, got "
                f"{type(updater).__name__}."
            )
        if updater.loss_module is not updaters[0].loss_module:
            raise ValueError(
                "The updaters of an UpdaterSequence must belong to one loss: build a sequence for "
                "each loss."
            )
        # TorchRL's own updaters follow every delayed network.
        ours = isinstance(updater, (_NetworkUpdater, UpdaterSequence))
        for name in updater.networks if ours else _delayed_networks(updater.loss_module):
            if name in owners:
                raise ValueError(
                    f"target_{name}_params has two updaters, {type(owners[name]).__name__} and "
                    f"{type(updater).__name__}: name each network in one of them only."
                )
            owners[name] = updater
    return owners
