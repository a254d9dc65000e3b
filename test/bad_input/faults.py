"""Bad input: one entry at a time is spoilt; a call must refuse it in clear words, or be right."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.utils._pytree import tree_flatten

import torchrl_ecpo

ROOT = Path(__file__).parents[2]
OURS = (str(Path(torchrl_ecpo.__file__).parent), str(ROOT / "sota-implementations"))
MISSING = object()
SHAPES = ("an axis", "one number", "empty", "too", "transposed")
Entries = Mapping[Any, Any]


class Impossible(Exception):
    """Bad input that cannot be made: a TensorDict refuses the shape."""


def tensordict_of(entries: Entries, shape: Sequence[int]) -> TensorDict:
    """A TensorDict with the entries, as far as it takes them."""
    data = TensorDict({}, shape)
    try:
        for key, value in entries.items():
            data[key] = value
    except RuntimeError as error:
        raise Impossible from error
    return data


class Fault(NamedTuple):
    """A bad value, and the good one that it may be taken for; None: it must be refused."""

    name: str
    bad: Any
    meant: Any = None


def _spoilt(x: Tensor, value: float) -> Tensor:
    x = x.clone()
    x.view(-1)[0] = value
    return x


def _of_any_tensor(x: Tensor) -> Iterator[Fault]:
    yield Fault("text", "text")
    yield Fault("an axis in front", x[None], x)
    yield Fault("an axis behind", x[..., None], x)
    yield (
        Fault("with gradient", x.detach().clone().requires_grad_(), x)
        if (x.is_floating_point())
        else Fault("complex", x.to(torch.complex64))
    )
    if x.ndim:
        yield Fault("empty", x[:0])
        yield Fault("an axis less", x[0], x[0].expand_as(x))
        yield Fault("one number", x.reshape(-1)[0], x.reshape(-1)[0].expand_as(x))
        for axis in {0, x.ndim - 1}:
            if x.shape[axis] > 2:  # one is broadcast
                yield Fault(f"too short in axis {axis}", x.narrow(axis, 0, x.shape[axis] - 1))
            if x.shape[axis] > 1:
                longer = torch.cat([x, x.narrow(axis, 0, 1)], axis)
                yield Fault(f"too long in axis {axis}", longer)
        if x.ndim > 1 and x.shape[-1] != x.shape[-2] and min(x.shape[-2:]) > 1:
            yield Fault("transposed", x.mT)


def _of_numbers(x: Tensor) -> Iterator[Fault]:
    yield from _of_any_tensor(x)
    for value in (math.nan, math.inf, -math.inf):
        yield Fault(str(value), _spoilt(x, value))
    yield Fault("complex", x.to(torch.complex64))
    yield Fault("integers", x.round().long(), x.round())
    yield Fault("flags", x > 0, (x > 0).to(x.dtype))
    other = torch.float64 if x.dtype == torch.float32 else torch.float32
    yield Fault("other precision", x.to(other), x)


def _of_flags(x: Tensor) -> Iterator[Fault]:
    yield from _of_any_tensor(x)
    yield Fault("integers", x.long(), x)
    yield Fault("floats", x.float(), x)
    yield Fault("nan", _spoilt(x.float(), math.nan))
    yield Fault("twos", 2 * x.long())


def _of_integers(x: Tensor) -> Iterator[Fault]:
    yield from _of_any_tensor(x)
    yield Fault("floats", x.float(), x)
    yield Fault("halves", x + 0.5)
    yield Fault("nan", _spoilt(x.float(), math.nan))
    yield Fault("int32", x.int(), x)
    yield Fault("uint8", x.to(torch.uint8), x)
    yield Fault("flags", x > 0)


def _of_float(x: float) -> Iterator[Fault]:
    yield from (Fault(str(value), value) for value in (math.nan, math.inf, -math.inf, -1.0, -1e-9))
    yield from (Fault(repr(value), value) for value in ("0.5", "text", None, 1j, [0.5], {}))
    yield Fault("numpy", np.float64(x), x)
    yield Fault("numpy float32", np.float32(x), float(np.float32(x)))
    yield Fault("tensor", torch.tensor(x), x)
    yield Fault("tensor of two", torch.tensor([x, x]))
    yield Fault("True", True)


def _of_count(x: int) -> Iterator[Fault]:
    yield from (
        Fault(repr(value), value) for value in (0, -1, x + 0.5, str(x), None, True, [x], 1j)
    )
    yield from (Fault(str(value), value) for value in (math.nan, math.inf))
    yield Fault("float", float(x), x)
    yield Fault("numpy", np.int64(x), x)
    yield Fault("numpy int32", np.int32(x), x)
    yield Fault("tensor", torch.tensor(x), x)


def _of_switch(x: bool) -> Iterator[Fault]:
    yield from (Fault(repr(value), value) for value in ("no", "false", "", None, 2, 0.5, []))
    yield Fault("integer", int(x), x)
    yield Fault("numpy", np.bool_(x), x)


def _of_choice(x: str) -> Iterator[Fault]:
    values = (x + "x", x.upper(), "", 3, True, [x])
    yield from (Fault(repr(value), value) for value in values)


def _of_sizes(x: Sequence[int]) -> Iterator[Fault]:
    yield from (Fault(repr(value), value) for value in ((), None, 3, "text", b"ab", {}, 1j))
    for value in (0, -1, 2.5, "3", None, True, math.nan, [3]):
        yield Fault(f"with {value!r}", (value, *x[1:]))
    yield Fault("list", list(x), x)
    yield Fault("numpy", np.array(x), x)
    yield Fault("tensor", torch.tensor(x), x)


def _of_object(x: Any) -> Iterator[Fault]:
    yield from (Fault(repr(value), value) for value in (None, "text", 3, math.nan, [], {}))
    if not isinstance(x, FunctionType):  # whose class is callable, too
        yield Fault("its class", type(x))
    yield Fault("an object", object())


def faults_of(value: Any) -> Iterator[Fault]:
    """The faults of a good value, by its kind."""
    if isinstance(value, Tensor):
        if value.dtype == torch.bool:
            yield from _of_flags(value)
        else:
            yield from (_of_numbers if value.is_floating_point() else _of_integers)(value)
    else:
        kinds = {
            bool: _of_switch,
            int: _of_count,
            float: _of_float,
            str: _of_choice,
            tuple: _of_sizes,
        }
        yield from kinds.get(type(value), _of_object)(value)


NO_NETWORKS = (
    Fault("text", lambda: "text"),
    Fault("None", lambda: None),
    Fault("a plain module", lambda: nn.Linear(3, 4)),
    Fault("a class", lambda: nn.Linear),
    Fault("a list", lambda: []),
)
"""Of what makes a network."""


class Subject(NamedTuple):
    """What is called, with good input.

    Attributes:
        call: of the entries; gives what must be equal for equal input.
        entries: by name (a key of a tensordict, an argument), those that are spoilt.
        faults: of an entry, in place of those of its kind.
        lone: tensors whose shape is theirs alone.
        fine: faults that are none here, with the reason: the result need only be finite.
        optional: entries that may be missing, or None.
        hands_on_nan: whether NaN and infinities of a tensor come out as such.
    """

    call: Callable[[dict[Any, Any]], Any]
    entries: Entries
    faults: Mapping[Any, Sequence[Fault]] = {}
    lone: Collection[Any] = ()
    fine: Mapping[tuple[Any, str], str] = {}
    optional: Collection[Any] = ()
    hands_on_nan: bool = False


def check(name: str, subject: Subject) -> None:
    """Nothing bad is accepted and wrong, and the counts are those that the documentation states."""
    refused, right = sweep(subject)
    row = f"| {name} | {refused} | {right} | 0 |"
    assert row in (ROOT / "docs/tests.md").read_text().splitlines(), f"docs/tests.md: {row}"


def sweep(subject: Subject) -> tuple[int, int]:
    """Spoil each entry in every way, one at a time: how many are refused, and how many right."""
    counts = {"refused": 0, "right": 0}
    wrong = []
    good = _result(subject, {})
    unused = set(subject.fine)
    for entry, value in subject.entries.items():
        faults = list(subject.faults.get(entry) or faults_of(value))
        if entry in subject.lone:
            faults = [fault for fault in faults if not fault.name.startswith(SHAPES)]
        if entry in subject.optional:
            faults = [fault for fault in faults if fault.bad is not None]
        else:
            faults.append(Fault("missing", MISSING))
        for fault in faults:
            unused.discard((entry, fault.name))
            expected = good if fault.meant is value else None
            verdict = _judge(subject, entry, fault, expected)
            if verdict in counts:
                counts[verdict] += 1
            elif verdict != "impossible":
                wrong.append(f"{entry}, {fault.name}: {verdict}")
    assert not unused, f"no such faults: {unused}"
    assert not wrong, "\n".join(["", *wrong])
    return counts["refused"], counts["right"]


def _judge(subject: Subject, entry: Any, fault: Fault, expected: list[Tensor] | None) -> str:
    """What becomes of a fault; `expected` of what it means, where that is known already."""
    try:
        found = _result(subject, {entry: fault.bad})
    except Impossible:
        return "impossible"
    except Exception as error:
        return "refused" if _is_clear(error, entry) else f"unclear: {error!r:.300}"
    is_handed_on = subject.hands_on_nan and isinstance(fault.bad, Tensor)
    if is_handed_on and fault.name in ("nan", "inf", "-inf"):
        return "right"
    if not all(bool(x.isfinite().all()) for x in found):
        return "accepted, and not finite"
    if (entry, fault.name) in subject.fine:
        return "right"
    if fault.meant is None:
        return "accepted"
    if expected is None:
        expected = _result(subject, {entry: fault.meant})
    same = len(found) == len(expected) and all(
        x.numel() == y.numel()
        and torch.allclose(x.reshape(-1).double(), y.reshape(-1).double(), 1e-4, 1e-6)
        for x, y in zip(found, expected, strict=True)
    )
    return "right" if same else "accepted, and not as what it means"


def _result(subject: Subject, changes: dict[Any, Any]) -> list[Tensor]:
    entries = {
        name: value.clone() if isinstance(value, Tensor) else value
        for name, value in {**subject.entries, **changes}.items()
        if value is not MISSING
    }
    result = subject.call(entries)
    if isinstance(result, TensorDictBase):
        result = dict(sorted(result.flatten_keys().items()))
    leaves, _ = tree_flatten(result)
    return [torch.as_tensor(leaf) for leaf in leaves if leaf is not None]


def _is_clear(error: Exception, entry: Any) -> bool:
    """One line, of this package, that names the entry."""
    if not isinstance(error, (ValueError, TypeError, KeyError, RuntimeError)):
        return False
    name, message = entry if isinstance(entry, str) else entry[-1], str(error)
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    assert trace is not None
    is_ours = trace.tb_frame.f_code.co_filename.startswith(OURS)
    # Python itself names an argument that is missing, torch an entry of a module's state.
    is_ours |= isinstance(error, TypeError) and "required" in message
    if message.startswith("Error(s) in loading state_dict"):
        is_ours, message = True, message.partition("\t")[2]
    return is_ours and name in message and "\n" not in message.strip() and len(message) < 600
