"""The settings of a training run."""

import os
from dataclasses import asdict, dataclass, field

from skinlib.datasets.augment import AugmentConfig
from skinlib.losses import LossWeights, TermWeights
from skinlib.model import CriticConfig, ModelConfig

SUPERVISED_ONLY = TermWeights(
    adversarial_s=0.0, adversarial_u=0.0, consistency=0.0, physical=0.0
)
# Small enough that the right weights stay the same; bones keep their order.
TWIN = AugmentConfig(
    collapse=0.0,
    mirror=0.0,
    resemble=0.0,
    pose=1.0,
    pose_degrees=1.5,
    warp=0.3,
    stretch=0.05,
    joint_jitter=0.003,
    reorder_bones=False,
)


@dataclass(frozen=True)
class TermForms:
    """In which form each term runs; `AS_WRITTEN` are the source's."""

    signs: str = "wgan"  # of D_s: wgan, or source as written
    positives: str = "labelled"  # what D_u takes for plausible; none as written
    consistency: str = "row_l1"  # row_l1, kl, or squares as written
    smooth: str = "dirichlet"  # dirichlet, or neighbours as written
    joint: str = "falloff"  # falloff, segments, or joints as written
    per_vertex: bool = True  # norm of the penalty a vertex; False as written

    def __post_init__(self):
        known = {
            "signs": ("wgan", "source"),
            "positives": ("labelled", "none"),
            "consistency": ("row_l1", "kl", "squares"),
            "smooth": ("dirichlet", "neighbours"),
            "joint": ("falloff", "segments", "joints"),
        }
        for name, options in known.items():
            if getattr(self, name) not in options:
                raise ValueError(
                    f"{name} is {getattr(self, name)!r}: use {' or '.join(options)}"
                )


AS_WRITTEN = TermForms("source", "none", "squares", "neighbours", "joints", False)


@dataclass(frozen=True)
class TrainConfig:
    """What a training run is; the same configuration and heads give the same model."""

    minutes: float = 30.0  # training time, unless `steps` is given
    steps: int | None = None  # number of steps, for runs that repeat to the bit
    batch: int = 2  # heads a step
    judged_nodes: int = 1024  # nodes of a head whose weights enter the loss
    optimizer: str = "muon"  # muon: for matrices, with AdamW for the rest; or adamw
    learning_rate: float = 5e-3  # after the warm-up
    weight_decay: float = 0.01  # pull of every parameter towards 0
    warmup: int = 100  # steps over which the learning rate rises
    cooldown: float = 0.5  # last part of the run, in which the learning rate falls to 0
    clip: float = 1.0  # largest norm of a step's gradient
    ema: float = 0.998  # decay of the averaged parameters that are kept
    seed: int = 0  # of parameters, order and augmentation
    threads: int = min(2, os.cpu_count() or 1)  # heads differentiated at once
    device: str = "cpu"  # cpu, cuda, cuda:1, ...
    validation_share: float = 0.08  # of the heads, when no validation heads are given
    validations: int = 20  # how often the run is validated
    save_seconds: float = 60.0  # how often the state to resume from is written
    remeshed: int = 0  # copies of each labelled head that have another mesh
    remeshed_share: float = 0.5  # of the draws of labelled heads, when there are copies
    unlabelled_share: float = 0.5  # of the draws, when unlabelled heads are given
    unlabelled_start: float = 0.0  # part of the run after which they are drawn
    propagate: bool = True  # unlabelled heads take over rows, see `Propagation`
    pseudo: float = 0.0  # how much a guessed row counts, beside an artist's
    critic_learning_rate: float = 5e-4  # of both critics, on the same schedule
    critic_steps: int = 1  # steps of the critics for one of the generator
    penalty: float = 10.0  # lambda_gp, of the critics' gradient penalty
    whole_nodes: int = 8192  # larger heads have neither critics nor physical term
    terms: TermWeights = SUPERVISED_ONLY  # alpha to epsilon
    forms: TermForms = field(default_factory=TermForms)
    critic: CriticConfig = field(default_factory=CriticConfig)
    twin: AugmentConfig = TWIN  # how the twin of the consistency term is disturbed
    model: ModelConfig = field(default_factory=ModelConfig)
    loss: LossWeights = field(default_factory=LossWeights)
    augment: AugmentConfig = field(default_factory=AugmentConfig)

    def __post_init__(self):
        if not any(asdict(self.terms).values()):
            raise ValueError("every weight in terms is 0: nothing would be learnt")
        twin = self.twin
        if not twin.keeps_mesh or twin.reorder_bones or twin.collapse or twin.mirror:
            raise ValueError(
                "twin changes the mesh or the bones, so that rows and columns of the "
                "two predictions would not be the same ones: see TWIN"
            )
