"""The network: a mesh encoder, a skeleton encoder, and cross-attention between them.

Beside it the critics of the adversarial training, which judge the weights it gives.
"""

from skinlib.model.critic import Critic, CriticConfig
from skinlib.model.inputs import MeshInput, SkeletonInput, prepare
from skinlib.model.skinning_model import ModelConfig, SkinningModel

__all__ = [
    "Critic",
    "CriticConfig",
    "MeshInput",
    "ModelConfig",
    "SkeletonInput",
    "SkinningModel",
    "prepare",
]
