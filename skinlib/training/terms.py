"""What one head adds to a step: the terms of the loss, of generator and of critics."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from skinlib.datasets.augment import augment
from skinlib.geometry import cotangents
from skinlib.graph import HybridGraph
from skinlib.head import Head
from skinlib.losses import (
    consistency,
    critic_loss,
    dirichlet,
    falloff_radii,
    generator_loss,
    gradient_penalty,
    joint_distance,
    joint_falloff,
    row_l1,
    smoothness,
    supervised,
    total,
    unsupervised_critic_loss,
    unsupervised_generator_loss,
)
from skinlib.model import Critic, SkinningModel
from skinlib.model.cross_attention import pair_features
from skinlib.model.inputs import MeshInput, SkeletonInput, mesh_input, skeleton_input
from skinlib.training.config import TrainConfig

D_S, D_U = "adversarial_s", "adversarial_u"


@dataclass(frozen=True)
class Sample:
    """A disturbed head and its graph; what nobody painted is guessed.

    Attributes:
        labelled: whether an artist painted it.
        known: (N,) bool, nodes whose weights are an artist's, painted here or taken
            over from another head.
        mixed: whether unlabelled heads are being drawn too, as D_u needs.
        mix: 0 .. 1, where between real and generated weights the penalty is taken.
    """

    head: Head
    graph: HybridGraph
    labelled: bool
    known: np.ndarray
    mixed: bool
    mix: float


@dataclass(frozen=True)
class Losses:
    """What generator and critics minimise on one sample, and numbers to show."""

    generator: Tensor
    critics: Tensor | None
    shown: dict[str, float]


def above_even(critic: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """A critic of one head, whose score counts from that of even rows, 1 / J each.

    Equation `adv_u`. D_u compares skins of different heads. Its slope in the weights is
    bounded by the penalty, but what it says of a head by itself is not: it would raise
    the score of every labelled mesh and lower that of every other one, without end.
    """

    def judge(weights: Tensor) -> Tensor:
        return critic(weights) - critic(even(weights))

    return judge


def even(weights: Tensor) -> Tensor:
    """(V, J) rows that give every bone the same."""
    return torch.full_like(weights, 1 / weights.shape[1])


class Terms:
    """The terms of a run: which there are, how they count, in which form.

    Args:
        critics: by the name of their term.
    """

    def __init__(
        self,
        config: TrainConfig,
        model: SkinningModel,
        critics: Mapping[str, Critic],
    ):
        self.config, self.model, self.critics = config, model, critics
        self.whole = bool(critics) or config.terms.physical > 0

    def losses(self, sample: Sample, rng: np.random.Generator) -> Losses:
        """Every term of one sample; `rng` decides the judged nodes and the twin."""
        config, device = self.config, self.config.device
        mesh = mesh_input(sample.head, sample.graph).to(device)
        skeleton = skeleton_input(sample.head).to(device)
        count = len(sample.graph)
        judged = torch.from_numpy(self._judged(sample, rng)).to(device)
        target = sample.head.weights[sample.graph.vertex_of_node]
        target = torch.from_numpy(target).to(device)
        # Critics and physics read whole meshes, which a huge one has no memory for.
        if self.whole and count <= config.whole_nodes:
            logits = self.model.node_logits(mesh, skeleton)
            predicted = logits.softmax(dim=1)
            terms = self._whole(predicted, target, sample, mesh, skeleton)
            critics, scores = self._critics(predicted, target, sample, mesh, skeleton)
            logits, predicted = logits[judged], predicted[judged]
        else:
            logits = self.model.node_logits(mesh, skeleton, judged)
            predicted, terms, critics, scores = logits.softmax(dim=1), {}, None, {}
        goal = target[judged]
        known = torch.from_numpy(sample.known).to(device)[judged]
        terms["supervised"] = self._supervised(logits, goal, known)
        if config.terms.consistency:
            twin = augment(sample.head, rng, config.twin)
            again = self.model.node_logits(
                mesh_input(twin, sample.graph).to(device),
                skeleton_input(twin).to(device),
                judged,
            )
            terms["consistency"] = consistency(
                again.softmax(dim=1), predicted.detach(), config.forms.consistency
            )
        shown = {name: term.item() for name, term in terms.items()} | scores
        error = row_l1(predicted.detach(), goal).item()
        shown["row_l1" if sample.labelled else "guess_row_l1"] = error
        return Losses(total(terms, config.terms), critics, shown)

    def _judged(self, sample: Sample, rng: np.random.Generator) -> np.ndarray:
        """Ids of the nodes that are compared with a target: those that have one."""
        config, count = self.config, len(sample.graph)
        some = sample.known.any() and not (config.pseudo or config.terms.consistency)
        places = np.flatnonzero(sample.known) if some else np.arange(count)
        drawn = min(len(places), config.judged_nodes)
        return places[rng.choice(len(places), drawn, replace=False)]

    def _supervised(self, logits, goal, known) -> Tensor:
        """L_sup, in which a row that nobody painted counts `pseudo`."""
        loss = logits.new_zeros(())
        for rows, weight in ((known, 1.0), (~known, self.config.pseudo)):
            if weight and rows.any():
                part = supervised(logits[rows], goal[rows], self.config.loss)
                loss = loss + weight * rows.float().mean() * part
        return loss

    def _whole(self, predicted, target, sample, mesh, skeleton) -> dict[str, Tensor]:
        """The generator's terms that need all nodes of a head."""
        terms = {}
        if sample.labelled and D_S in self.critics:
            score = self.critics[D_S](mesh, skeleton, predicted)
            terms[D_S] = generator_loss(score)
        if not sample.labelled and D_U in self.critics:
            critic = self.critics[D_U].on(mesh, skeleton)
            as_written = self.config.forms.positives == "none"
            critic = critic if as_written else above_even(critic)
            terms[D_U] = unsupervised_generator_loss(critic(predicted), as_written)
        if self.config.terms.physical:
            faces = sample.graph.node_of_vertex[sample.head.faces]
            points = sample.head.vertices[sample.graph.vertex_of_node]
            smooth = self._smooth(predicted, points, faces, mesh)
            joint = self._joint(predicted, target, mesh, skeleton)
            terms["physical"] = smooth + joint
        return terms

    def _smooth(self, predicted, points, faces, mesh: MeshInput) -> Tensor:
        if self.config.forms.smooth == "neighbours":
            return smoothness(predicted, mesh.neighbours, mesh.used)
        edges, weights = (torch.from_numpy(a) for a in cotangents(points, faces))
        device = predicted.device
        return dirichlet(predicted, edges.to(device), weights.to(device))

    def _joint(self, predicted, target, mesh, skeleton: SkeletonInput) -> Tensor:
        form = self.config.forms.joint
        pairs = pair_features(mesh.positions, mesh.normals, skeleton)
        distances = pairs[..., 0 if form == "joints" else 1]
        if form != "falloff":
            return joint_distance(predicted, distances)
        return joint_falloff(
            predicted, distances, falloff_radii(target, distances, mesh.areas)
        )

    def _critics(self, predicted, target, sample, mesh, skeleton):
        """(what the critics minimise on this sample, their scores to show)."""
        config, forms = self.config, self.config.forms
        fake, losses, scores = predicted.detach(), [], {}
        share = config.unlabelled_share

        def penalty(critic, real):
            slope = gradient_penalty(
                critic, real, fake, sample.mix, per_vertex=forms.per_vertex
            )
            return config.penalty * slope

        def score(name, kind, value):
            scores[f"{name}_{kind}"] = value.item()
            return value

        if sample.labelled and D_S in self.critics:
            critic = self.critics[D_S].on(mesh, skeleton)
            real = score(D_S, "real", critic(target))
            made = score(D_S, "fake", critic(fake))
            losses.append(critic_loss(real, made, forms.signs))
            losses.append(penalty(critic, target))
        if sample.mixed and D_U in self.critics:
            critic = self.critics[D_U].on(mesh, skeleton)
            if forms.positives == "none" and not sample.labelled:
                made = score(D_U, "fake", critic(fake))
                losses.append(unsupervised_critic_loss(made))
                losses.append(penalty(critic, fake))
            if forms.positives == "labelled":
                # One part of the draws brings the real scores, the other the fake
                # ones: divided by their shares, so that a constant cancels.
                critic = above_even(critic)
                if sample.labelled:
                    real = score(D_U, "real", critic(target))
                    losses.append(-real / (1 - share))
                    losses.append(penalty(critic, target))
                else:
                    made = score(D_U, "fake", critic(fake))
                    losses.append(made / share)
                    losses.append(
                        penalty(critic, torch.full_like(fake, 1 / fake.shape[1]))
                    )
        return (torch.stack(losses).sum() if losses else None), scores
