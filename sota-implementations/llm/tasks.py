"""Two tasks whose answers a program can verify, one with many right answers and one with a single.

They ask for the inverse of each other, in the same fifteen characters, so that a model of two
layers learns their form from some hundred batches. Answers are of at most eight tokens.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from random import Random
from typing import Protocol

ALPHABET = "0123456789+-,=:"


class Task(Protocol):
    """Prompts, and what is right."""

    max_tokens: int
    """Of an answer, its end included."""

    def draw(self, random: Random) -> tuple[str, str]:
        """A prompt and one right answer, for the supervised start."""
        ...

    def is_right(self, prompt: str, answer: str) -> bool:
        """Whether an answer is right."""
        ...


class Countdown:
    """Reach a target with some of four digits: ``2,5,6,8=13:`` has ``5+8``, ``8+5``, ``6-2+..``."""

    max_tokens = 8

    def draw(self, random: Random) -> tuple[str, str]:
        """Targets are those of random expressions, and above 0."""
        digits = random.sample(range(1, 10), 4)
        answer = _expression(random, digits)
        while _value(answer) <= 0:
            answer = _expression(random, digits)
        return f"{','.join(map(str, digits))}={_value(answer)}:", answer

    def is_right(self, prompt: str, answer: str) -> bool:
        """Whether it is an expression of the prompt's digits, each at most once, and its value."""
        digits, target = prompt[:-1].split("=")
        used = re.findall(r"\d", answer)
        is_expression = re.fullmatch(r"[1-9]([+-][1-9])*", answer, re.ASCII) is not None
        is_allowed = len(used) == len(set(used)) and set(used) <= set(digits)
        return is_expression and is_allowed and _value(answer) == int(target)


class Sums:
    """The value of an expression of two to four digits: ``5+9-3=`` has ``11``."""

    max_tokens = 4

    def draw(self, random: Random) -> tuple[str, str]:
        """Expressions as in the answers of Countdown."""
        expression = _expression(random, random.sample(range(1, 10), 4))
        return f"{expression}=", str(_value(expression))

    def is_right(self, prompt: str, answer: str) -> bool:
        """Whether it is the number."""
        return answer == str(_value(prompt))


TASKS: dict[str, Task] = {"countdown": Countdown(), "sums": Sums()}


def _expression(random: Random, digits: Sequence[int]) -> str:
    first, *others = random.sample(digits, random.randint(2, len(digits)))
    return str(first) + "".join(random.choice("+-") + str(digit) for digit in others)


def _value(expression: str) -> int:
    return sum(map(int, re.findall(r"[+-]?\d", expression)))
