"""What an update by completions of a language model takes in memory, beside TorchRL's GRPOLoss.

    python benchmarks/llm_memory.py --csv llm_memory.csv

One thread. Of a loss's forward and backward pass: the most bytes of tensors that live at once
beyond those that live before it, and median processor time. All take one batch, groups of 8
completions, and one two-layer Llama. TorchRL's GRPOLoss is without its entropy bonus, which takes
more.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from common import read_arguments, write_csv
from tensordict import TensorDict
from torch import Tensor
from torch.profiler import ProfilerActivity, profile
from torchrl.modules.llm import TransformersWrapper
from torchrl.objectives.llm import GRPOLoss as TorchRLGRPOLoss
from transformers import LlamaConfig, LlamaForCausalLM, PreTrainedTokenizerFast

from torchrl_ecpo import ECPOLoss, GRPOLoss

VOCABULARY, GROUP_SIZE = 1_000, 8
SIZES = ((32, 512, 1024), (32, 64, 256), (8, 16, 1024))
"""Completions, tokens of a prompt, tokens of a completion."""


def make_actor(length: int) -> Any:
    """A Llama made from its config, and a tokenizer that has but its special tokens."""
    from tokenizers import Tokenizer, models

    config = LlamaConfig(
        vocab_size=VOCABULARY,
        hidden_size=64,
        intermediate_size=128,
        num_hidden_layers=2,
        num_attention_heads=2,
        num_key_value_heads=2,
        max_position_embeddings=length,
    )
    words = {"<pad>": 0, "<end>": 1, "<unk>": 2}
    tokenizer = PreTrainedTokenizerFast(
        tokenizer_object=Tokenizer(models.WordLevel(words, "<unk>")),
        pad_token="<pad>",
        eos_token="<end>",
        unk_token="<unk>",
    )
    return TransformersWrapper(
        LlamaForCausalLM(config).eval(),
        tokenizer=tokenizer,
        input_mode="tokens",
        generate=False,
        pad_output=True,
    )


def make_batch(rows: int, of_prompt: int, of_completion: int) -> TensorDict:
    """Random completions of one length, the dearest case: nothing is padding."""
    tokens = torch.randint(3, VOCABULARY, (rows, of_prompt + of_completion))
    return TensorDict(
        {
            "tokens": {"prompt": tokens[:, :of_prompt], "full": tokens},
            "masks": {"all_attention_mask": torch.ones_like(tokens, dtype=torch.bool)},
            "log_probs": {"full": torch.full(tokens.shape, -7.0)},
            "query": torch.arange(rows) // GROUP_SIZE,
            "advantage": torch.randn(rows, 1, 1),
            "next": {"reward": torch.randn(rows, 1, 1)},
        },
        [rows],
    )


def peak(update: Callable[[], object]) -> float:
    """The most that lives at once beyond what lives before, in MB."""
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiler:
        update()
    recorded: Any = profiler.profiler
    alive = most = 0
    for event in sorted(recorded.kineto_results.events(), key=lambda event: event.start_ns()):
        if event.name() == "[memory]":
            alive += event.nbytes()
            most = max(most, alive)
    return most / 2**20


def measure(sizes: tuple[int, int, int], repeats: int) -> dict[str, tuple[float, float]]:
    """Of each loss, the peak in MB and the time of an update in milliseconds."""
    torch.manual_seed(0)
    actor, batch = make_actor(sum(sizes[1:])), make_batch(*sizes)
    theirs = TorchRLGRPOLoss(actor, entropy_bonus=False)
    ecpo, grpo = ECPOLoss(actor), GRPOLoss(actor)
    losses: dict[str, Callable[[], Tensor]] = {
        "TorchRL's GRPOLoss": lambda: theirs(batch).loss_objective,
        "GRPOLoss": lambda: grpo(batch)["loss_actor"],
        "ECPOLoss": lambda: ecpo(batch)["loss_actor"],
    }

    def update(loss: Callable[[], Tensor]) -> float:
        actor.zero_grad()
        started = time.process_time()
        loss().backward()
        return 1e3 * (time.process_time() - started)

    found = {}
    for name, loss in losses.items():
        times = [update(loss) for _ in range(repeats + 1)][1:]
        found[name] = peak(lambda loss=loss: update(loss)), statistics.median(times)
    return found


def main() -> None:
    arguments = read_arguments(__doc__, repeats=3)
    table = []
    for sizes in SIZES:
        found = measure(sizes, arguments.repeats)
        for name, (megabytes, ms) in found.items():
            row = dict(zip(("completions", "prompt", "tokens"), sizes, strict=True))
            row |= {"loss": name, "peak_mb": megabytes}
            row |= {"ratio": megabytes / found["TorchRL's GRPOLoss"][0], "ms": ms}
            print(*row.values(), sep="\t", flush=True)
            table.append(row)
    write_csv(arguments.csv, table)


if __name__ == "__main__":
    main()
