"""What the training of pose transfer lowers: distance to the truth, stretched edges.

Source: the project's second text, section 3.3. Each function is the mean over a batch,
differentiable everywhere. Equation ids are those of docs/equations.md.

Symbols: B batch, N vertices, E edges. Points are normalised, so there is no unit.
"""

from typing import Literal, get_args

import torch
from torch import Tensor

from skinlib.head import HeadError

EDGE_WEIGHT = 0.0005
"""lambda, the factor of the edge term beside the reconstruction."""

LEAST_LENGTH = 1e-6
"""An edge of the truth that is shorter has no length to compare with."""

EdgeForm = Literal["length", "squared"]


def pose_reconstruction(predicted: Tensor, truth: Tensor) -> Tensor:
    """Mean over the vertices of the squared distance to the truth.

    L_rec = 1/N sum_i |p_i - g_i|^2

    Equation `pose_reconstruction`. The authors' code takes the mean over coordinates,
    a third of this, which is also what the field measures as PMD.

    Args:
        predicted, truth: (B, N, 3), vertex by vertex the same order.

    Raises:
        HeadError: shapes that differ, or no vertex.

    >>> predicted = torch.tensor([[[1.0, 2, 2], [0, 0, 0]]])
    >>> pose_reconstruction(predicted, torch.zeros(1, 2, 3))
    tensor(4.5000)
    """
    _check_pair("truth", predicted, truth)
    return (predicted - truth).square().sum(-1).mean()


def pose_edge(
    predicted: Tensor, reference: Tensor, edges: Tensor, form: EdgeForm = "length"
) -> Tensor:
    """Mean over the edges of how far each is from its right length, as a share of it.

    L_edg = 1/E sum_e |l_e / l_e(truth) - 1|

    Equation `pose_edge`. An edge of the reference shorter than `LEAST_LENGTH` is left
    out; with none left the loss is 0.

    Args:
        predicted: (B, N, 3).
        reference: (B, N, 3) with the right lengths: the truth, as the source says; the
            authors' code gives the identity and `form="squared"`.
        edges: (E, 2) int64 of all meshes, or (B, E, 2) of each.
        form: "squared" compares squared lengths.

    Raises:
        HeadError: shapes that do not fit, ids out of range, an unknown form.

    >>> truth = torch.tensor([[[0.0, 0, 0], [3, 4, 0]]])
    >>> edges = torch.tensor([[0, 1]])
    >>> pose_edge(2 * truth, truth, edges)
    tensor(1.)
    >>> pose_edge(2 * truth, truth, edges, "squared")
    tensor(3.)
    """
    _check_pair("reference", predicted, reference)
    if form not in get_args(EdgeForm):
        raise HeadError("form", f"{form!r}", f"choose from {get_args(EdgeForm)}")
    edges = _checked_edges(edges, predicted)
    lengths, right = (
        _squared_lengths(predicted, edges),
        _squared_lengths(reference, edges),
    )
    used = right > LEAST_LENGTH**2
    right = torch.where(used, right, 1)
    ratio = lengths / right
    if form == "length":
        # Far below any length that counts: the root has a derivative at 0, too.
        ratio = (ratio + 1e-12).sqrt()
    off = torch.where(used, (ratio - 1).abs(), 0)
    return off.sum() / used.sum().clamp(min=1)


def pose_loss(
    predicted: Tensor, truth: Tensor, edges: Tensor, edge_weight: float = EDGE_WEIGHT
) -> Tensor:
    """L_rec + lambda L_edg, both against the truth: the source's equation (6).

    Args:
        predicted, truth: (B, N, 3). edges: (E, 2) or (B, E, 2) int64.
        edge_weight: lambda; with 0 the edges are not looked at, the third ablation.

    >>> truth = torch.tensor([[[0.0, 0, 0], [3, 4, 0]]])
    >>> pose_loss(2 * truth, truth, torch.tensor([[0, 1]]), edge_weight=0.5)
    tensor(13.)
    """
    loss = pose_reconstruction(predicted, truth)
    if not edge_weight:
        return loss
    return loss + edge_weight * pose_edge(predicted, truth, edges)


def _squared_lengths(points: Tensor, edges: Tensor) -> Tensor:
    """(B, E) from (B, N, 3) and (B, E, 2)."""
    ends = points.gather(1, edges.flatten(1)[..., None].expand(-1, -1, 3))
    start, end = ends.unflatten(1, (-1, 2)).unbind(2)
    return (end - start).square().sum(-1)


def _check_pair(name: str, predicted: Tensor, other: Tensor) -> None:
    if predicted.dim() != 3 or predicted.shape[2] != 3 or not predicted.numel():
        raise HeadError(
            "predicted", f"shape {tuple(predicted.shape)}", "give (B, N, 3), not empty"
        )
    if predicted.shape != other.shape:
        raise HeadError(
            name,
            f"shape {tuple(other.shape)} for {tuple(predicted.shape)} predicted",
            "give the same vertices in the same order",
        )


def _checked_edges(edges: Tensor, points: Tensor) -> Tensor:
    """(B, E, 2), or `HeadError`."""
    shape = tuple(edges.shape)
    if edges.dim() == 2:
        edges = edges.expand(len(points), -1, -1)
    if edges.dim() != 3 or edges.shape[::2] != (len(points), 2):
        raise HeadError("edges", f"shape {shape}", "give (E, 2) or (B, E, 2)")
    if edges.dtype != torch.int64:
        raise HeadError("edges", f"{edges.dtype}", "give int64 vertex ids")
    # The processor checks ids itself, late and unclearly; an accelerator would halt.
    if not edges.is_cuda and edges.numel():
        low, high = edges.min(), edges.max()
        if low < 0 or high >= points.shape[1]:
            raise HeadError(
                "edges",
                f"ids from {low} to {high} for {points.shape[1]} vertices",
                f"give 0 to {points.shape[1] - 1}",
            )
    return edges
