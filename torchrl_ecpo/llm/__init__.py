"""Groups of completions: what TorchRL's language-model wrappers write."""

from torchrl_ecpo.llm.completions import check_sampler, record_log_probs

__all__ = ["check_sampler", "record_log_probs"]
