"""From a head to what the network reads, in the head's own frame."""

import hashlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Self

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from skinlib.geometry import (
    Frame,
    canonical_frame,
    curvature,
    normal_deviation,
    vertex_areas,
)
from skinlib.graph import MESH, GraphConfig, build_graph, node_areas, node_normals
from skinlib.head import Head

# Curvature is 1 / radius; a lid or a lip bends about 10 times as much as the skull.
CURVATURE_UNIT = 10.0
# In head radii: nothing that belongs to a head is further away. What is (a vertex left
# behind, a bone in another unit) would overflow once squared.
FAR = 1e3
CACHE_VERSION = "4"
MIN_FRAME_BONES = 5


@dataclass(frozen=True)
class _Tensors:
    def to(self, device: torch.device | str) -> Self:
        """A copy on another device."""
        return type(self)(*(getattr(self, f.name).to(device) for f in fields(self)))


@dataclass(frozen=True)
class MeshInput(_Tensors):
    """What the mesh encoder reads: N nodes with K neighbours, over V vertices.

    Positions are in the head's frame (`bone_frame`), so they have no unit.
    """

    positions: Tensor  # (N, 3)
    normals: Tensor  # (N, 3), unit
    curvature: Tensor  # (N,), squashed to -1 .. 1
    deviation: Tensor  # (N,), 0 .. 2
    areas: Tensor  # (N,), share of the surface, mean 1
    valence: Tensor  # (N,), mesh edges a node has, less the 6 of a regular mesh
    neighbours: Tensor  # (N, K) int64
    kinds: Tensor  # (N, K) int8, MESH or SPACE; -1 where `neighbours` is only filled up
    island: Tensor  # (N,) int64
    node_of_vertex: Tensor  # (V,) int64

    @property
    def used(self) -> Tensor:
        """(N, K) bool: which neighbours are more than a filling of the table."""
        return self.kinds >= 0

    @property
    def mesh_neighbours(self) -> Tensor:
        """(N, K) int64: `neighbours`, with those in space replaced by the first one."""
        first = self.neighbours[:, :1]
        return torch.where(self.kinds == MESH, self.neighbours, first)


@dataclass(frozen=True)
class SkeletonInput(_Tensors):
    """What the skeleton encoder reads: J bones in the head's frame."""

    joints: Tensor  # (J, 3)
    directions: Tensor  # (J, 3), unit or 0
    lengths: Tensor  # (J,)
    parents: Tensor  # (J,) int64, -1 for a root
    depths: Tensor  # (J,) int64

    @property
    def tails(self) -> Tensor:
        """(J, 3) bone ends."""
        return self.joints + self.lengths[:, None] * self.directions


def prepare(
    head: Head, config: GraphConfig | None = None, cache: Path | None = None
) -> tuple[MeshInput, SkeletonInput]:
    """Everything the network reads of a head.

    Args:
        cache: a folder that keeps the result under the hash of the head's content, so
            that the graph of a mesh is built once.
    """
    config = config or GraphConfig()
    if cache is None:
        return _prepare(head, config)
    path = Path(cache) / f"{content_hash(head, config)}.safetensors"
    try:
        stored = load_file(path)
        return tuple(
            kind(*(stored[f"{kind.__name__}.{f.name}"] for f in fields(kind)))
            for kind in (MeshInput, SkeletonInput)
        )
    except (FileNotFoundError, SafetensorError, KeyError):
        prepared = _prepare(head, config)  # not there yet, or damaged
    flat = {
        f"{type(part).__name__}.{f.name}": getattr(part, f.name).contiguous()
        for part in prepared
        for f in fields(part)
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(f".{np.random.default_rng().integers(2**32)}")
    save_file(flat, partial)
    partial.replace(path)
    return prepared


def content_hash(head: Head, config: GraphConfig) -> str:
    """A name for a head's geometry: the same arrays have the same name everywhere."""
    digest = hashlib.sha256(f"{CACHE_VERSION} {config}".encode())
    skeleton = head.skeleton
    for array in (head.vertices, head.normals, head.faces, skeleton.joints):
        digest.update(str(array.shape).encode() + array.tobytes())
    for array in (skeleton.parents, skeleton.lengths, skeleton.directions):
        digest.update(array.tobytes())
    return digest.hexdigest()[:32]


def _prepare(head, config):
    graph, frame = build_graph(head, config, torch.get_num_threads()), bone_frame(head)
    return mesh_input(head, graph, frame), skeleton_input(head, frame)


def bone_frame(head: Head) -> Frame:
    """The frame the network sees: axes of `canonical_frame`, sized by the bones.

    Hair, hats and collars move the middle of the surface, not the face bones. So the
    origin is the median joint and the scale twice the median distance from it. Fewer
    than five bones say too little; the surface decides then.
    """
    skeleton = head.skeleton
    joints = skeleton.joints.astype(np.float64)
    frame = canonical_frame(head.vertices, head.faces, joints, skeleton.parents)
    if len(joints) < MIN_FRAME_BONES:
        return frame
    centre = np.median(joints, axis=0)
    scale = 2 * float(np.median(np.linalg.norm(joints - centre, axis=1)))
    # Bones all but in one place, or far from the mesh, say nothing about its size.
    if not frame.scale / 10 < scale < frame.scale * 10:
        return frame
    return Frame(frame.rotation, centre, scale)


def mesh_input(head: Head, graph, frame: Frame | None = None) -> MeshInput:
    """The mesh half; `graph` may come from an earlier pose of the same mesh."""
    frame = frame or bone_frame(head)
    positions = frame.apply(head.vertices[graph.vertex_of_node])
    areas = vertex_areas(head.vertices, head.faces)
    normals = node_normals(head.normals, graph.node_of_vertex, len(graph), areas)
    normals = frame.rotate(normals)
    bend = curvature(positions, normals, graph.edges) / CURVATURE_UNIT
    areas = node_areas(head, graph.node_of_vertex, len(graph))
    mean_area = areas.mean()
    areas = areas / mean_area if mean_area > 0 else np.ones_like(areas)
    return MeshInput(
        _float(np.clip(positions, -FAR, FAR)),
        _float(normals),
        _float(np.tanh(bend)),
        _float(normal_deviation(normals, graph.edges)),
        _float(areas),
        _float(np.bincount(graph.edges.ravel(), minlength=len(graph)) - 6),
        torch.from_numpy(graph.neighbours),
        torch.from_numpy(graph.kinds),
        torch.from_numpy(graph.island),
        torch.from_numpy(graph.node_of_vertex),
    )


def skeleton_input(head: Head, frame: Frame | None = None) -> SkeletonInput:
    """The skeleton half."""
    frame, skeleton = frame or bone_frame(head), head.skeleton
    return SkeletonInput(
        _float(np.clip(frame.apply(skeleton.joints), -FAR, FAR)),
        _float(frame.rotate(skeleton.directions)),
        _float(np.minimum(skeleton.lengths.astype(float) / frame.scale, FAR)),
        torch.from_numpy(np.array(skeleton.parents)),
        torch.from_numpy(skeleton.depths),
    )


def _float(array) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))
