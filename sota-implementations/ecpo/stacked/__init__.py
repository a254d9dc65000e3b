"""Several independent runs in one process: what ``seeds=[...]`` and ``stack=[...]`` ask for.

Each run is built as it would be alone: environment, policy, loss, optimiser, temperatures, record.
What they share is the collector, in which they step and act together, and the evaluation of the
policy on what was collected. R is the number of runs; a batch ``[R * num_groups, group_size, T]``
holds them one after another.
"""

from stacked.options import check_runs, runs_of
from stacked.training import train_stack

__all__ = ["check_runs", "runs_of", "train_stack"]
