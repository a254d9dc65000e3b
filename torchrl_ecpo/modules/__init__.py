"""The policies that the scripts build."""

from torchrl_ecpo.modules.recurrent import DistinctHistoryLSTM
from torchrl_ecpo.modules.softmax import LinearSoftmax, SharedCategorical, make_softmax_policy
from torchrl_ecpo.modules.tuple_policy import TupleCategorical, make_tuple_policy

__all__ = [
    "DistinctHistoryLSTM",
    "LinearSoftmax",
    "SharedCategorical",
    "TupleCategorical",
    "make_softmax_policy",
    "make_tuple_policy",
]
