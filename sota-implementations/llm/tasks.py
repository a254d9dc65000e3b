"""Two tasks whose answers a program can verify, one with many right answers and one with a single.

They ask for the inverse of each other, in the same fifteen characters, so that a model of two
layers learns their form from some hundred batches.
"""

from __future__ import annotations

import re
from random import Random

ALPHABET = "0123456789+-,=:"


class Countdown:
    """Reach a target with some of four digits: of ``2,5,6,8=13:`` it is ``5+8`` and five more."""

    max_tokens = 8  # of an answer, with its end

    def draw(self, random: Random) -> tuple[str, str]:
        """A prompt and a right answer; targets are those of random expressions, and above 0."""
        digits = random.sample(range(1, 10), 4)
        while _value(answer := _expression(random, digits)) <= 0:
            pass
        return f"{','.join(map(str, digits))}={_value(answer)}:", answer

    def is_right(self, prompt: str, answer: str) -> bool:
        """Whether it is an expression of the prompt's digits, each at most once, and its value."""
        digits, target = prompt[:-1].split("=")
        used = re.findall(r"\d", answer)
        if len(used) > len(set(used)) or not set(used) <= set(digits):
            return False
        return bool(re.fullmatch(r"\d([+-]\d)*", answer)) and _value(answer) == int(target)


class Sums:
    """The value of an expression of two to four digits: of ``5+9-3=`` it is ``11``."""

    max_tokens = 4

    def draw(self, random: Random) -> tuple[str, str]:
        """A prompt and its answer; expressions are as in the answers of Countdown."""
        expression = _expression(random, random.sample(range(1, 10), 4))
        return f"{expression}=", str(_value(expression))

    def is_right(self, prompt: str, answer: str) -> bool:
        """Whether it is the number."""
        return answer == str(_value(prompt))


TASKS = {"countdown": Countdown(), "sums": Sums()}


def _expression(random: Random, digits: list[int]) -> str:
    first, *others = random.sample(digits, random.randint(2, len(digits)))
    return str(first) + "".join(random.choice("+-") + str(digit) for digit in others)


def _value(expression: str) -> int:
    return sum(map(int, re.findall(r"[+-]?\d", expression)))
