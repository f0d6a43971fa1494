"""What an adversarial training step costs, in supervised steps.

    python benchmarks/adversarial_step.py

Prints CPU milliseconds (median of 9 rounds, one thread, kinds of step in turn, so that
a busy machine slows all alike) on heads of about 2,000 vertices and 30 bones, with the
default networks. A supervised step is the generator forward, backward from as many
nodes as training judges, and AdamW; preparing a head is left out, which every kind of
step would pay alike. Critics need the weights of all nodes.

- supervised_all_nodes: the same, with all nodes judged.
- critic: one critic's score of real and fake weights, its penalty, and AdamW.
- one_critic: the generator with L_sup and D_s's opinion, and a step of D_s.
- both_critics: the same, an unlabelled head with D_u's opinion, and a step of D_u.
"""

import json
import statistics
import time

import numpy as np
import torch

from skinlib import Head, Skeleton
from skinlib.datasets.synthetic import synthetic_head
from skinlib.losses import (
    critic_loss,
    generator_loss,
    gradient_penalty,
    supervised,
    unsupervised_critic_loss,
)
from skinlib.model import Critic, SkinningModel, prepare
from skinlib.training import TrainConfig

VERTICES, BONES, ROUNDS = 2000, 30, 9


def head_with_bones(seed: int) -> Head:
    """A synthetic head whose bones were replaced by a random tree of `BONES`."""
    head = synthetic_head(seed, vertices=VERTICES)
    rng = np.random.default_rng(seed)
    joints = 0.8 * rng.choice(head.vertices, BONES, replace=False)
    parents = [-1] + [int(rng.integers(bone)) for bone in range(1, BONES)]
    names = [f"bone_{bone}" for bone in range(BONES)]
    skeleton = Skeleton.from_heads_and_tails(joints, None, parents, names)
    return Head.create(head.vertices, head.faces, skeleton)


class Bench:
    """Two heads, the generator and both critics, and one method a kind of step."""

    def __init__(self):
        torch.manual_seed(0)
        self.heads = [prepare(head_with_bones(seed)) for seed in (1, 2)]
        self.real = [
            torch.randn(len(mesh.positions), BONES).mul(3).softmax(dim=1)
            for mesh, _ in self.heads
        ]
        self.generator, self.critics = SkinningModel(), (Critic(), Critic())
        networks = (self.generator, *self.critics)
        self.optimizers = {net: torch.optim.AdamW(net.parameters()) for net in networks}

    def follow(self, network, loss):
        """One update of one network's parameters alone."""
        parameters = list(network.parameters())
        gradients = torch.autograd.grad(loss, parameters)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        self.optimizers[network].step()

    def supervised(self, judged: int) -> None:
        """The supervised step: so many nodes of the labelled head."""
        mesh, skeleton = self.heads[0]
        nodes = torch.randperm(len(mesh.positions))[:judged]
        logits = self.generator.node_logits(mesh, skeleton, nodes)
        self.follow(self.generator, supervised(logits, self.real[0][nodes]))

    def generator_step(self, critics: int) -> list:
        """The generator's step beside critics; returns the weights of each head."""
        loss, guesses = 0.0, []
        for i in range(critics):
            mesh, skeleton = self.heads[i]
            logits = self.generator.node_logits(mesh, skeleton)
            weights = logits.softmax(dim=1)
            if i == 0:
                loss = loss + supervised(logits, self.real[i])
            loss = loss + 0.1 * generator_loss(self.critics[i](mesh, skeleton, weights))
            guesses.append(weights.detach())
        self.follow(self.generator, loss)
        return guesses

    def critic_step(self, i: int = 0, fake=None) -> None:
        """A step of D_s, 0, or D_u, 1, whose real weights are of the labelled head."""
        judge = self.critics[i].on(*self.heads[i])
        fake = self.real[i].roll(1, dims=1) if fake is None else fake
        if i == 0:
            loss = critic_loss(judge(self.real[0]), judge(fake))
            penalty = gradient_penalty(judge, self.real[0], fake, mix=0.5)
        else:
            real = self.critics[i](*self.heads[0], self.real[0])
            loss = unsupervised_critic_loss(judge(fake), real)
            penalty = gradient_penalty(judge, fake, fake, mix=0.5)
        self.follow(self.critics[i], loss + 10 * penalty)

    def adversarial(self, critics: int) -> None:
        """A whole step with D_s, or with D_s and D_u."""
        guesses = self.generator_step(critics)
        for i in range(critics):
            self.critic_step(i, guesses[i])


def main() -> None:
    """Measure every kind of step in turn and print the table."""
    torch.set_num_threads(1)
    bench = Bench()
    steps = {
        "supervised": lambda: bench.supervised(TrainConfig().judged_nodes),
        "supervised_all_nodes": lambda: bench.supervised(2 * VERTICES),
        "critic": bench.critic_step,
        "one_critic": lambda: bench.adversarial(1),
        "both_critics": lambda: bench.adversarial(2),
    }
    seconds = {name: [] for name in steps}
    for _ in range(ROUNDS + 1):
        for name, step in steps.items():
            began = time.process_time()
            step()
            seconds[name].append(time.process_time() - began)
    cost = {name: statistics.median(times[1:]) for name, times in seconds.items()}
    rows = {
        name: {
            "milliseconds": round(1e3 * time, 1),
            "supervised_steps": round(time / cost["supervised"], 2),
        }
        for name, time in cost.items()
    }
    parameters = {
        "generator": sum(p.numel() for p in bench.generator.parameters()),
        "critic": sum(p.numel() for p in bench.critics[0].parameters()),
    }
    print(json.dumps(rows | {"parameters": parameters}, indent=1))


if __name__ == "__main__":
    main()
