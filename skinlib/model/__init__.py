"""The network: a mesh encoder, a skeleton encoder, and cross-attention between them."""

from skinlib.model.inputs import MeshInput, SkeletonInput, prepare
from skinlib.model.skinning_model import ModelConfig, SkinningModel

__all__ = ["MeshInput", "ModelConfig", "SkeletonInput", "SkinningModel", "prepare"]
