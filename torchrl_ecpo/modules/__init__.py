"""The policies and critics that the scripts build."""

from torchrl_ecpo.modules.actor_critic import (
    DenseNetwork,
    make_action_value_network,
    make_categorical_actor,
    make_deterministic_actor,
    make_qvalue_network,
    make_tanh_gaussian_actor,
    make_value_network,
)
from torchrl_ecpo.modules.latents import record_latents
from torchrl_ecpo.modules.pixels import PixelEncoder
from torchrl_ecpo.modules.recurrent import DistinctHistoryLSTM
from torchrl_ecpo.modules.softmax import LinearSoftmax, SharedCategorical, make_softmax_policy
from torchrl_ecpo.modules.tuple_policy import TupleCategorical, TupleTables, make_tuple_policy
from torchrl_ecpo.modules.windows import DistinctWindowNetwork, OneHotLinear

__all__ = [
    "DenseNetwork",
    "DistinctHistoryLSTM",
    "DistinctWindowNetwork",
    "LinearSoftmax",
    "OneHotLinear",
    "PixelEncoder",
    "SharedCategorical",
    "TupleCategorical",
    "TupleTables",
    "make_action_value_network",
    "make_categorical_actor",
    "make_deterministic_actor",
    "make_qvalue_network",
    "make_softmax_policy",
    "make_tanh_gaussian_actor",
    "make_tuple_policy",
    "make_value_network",
    "record_latents",
]
