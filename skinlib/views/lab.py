"""The loss lab: a small head is learnt while you turn the weights of its loss.

`LabRun` is the run and its pictures, without any widget. `LossLab` puts sliders and
buttons on it. Training is the package's own `Trainer`, one labelled and one unlabelled
head a step; only the settings change while it goes on.
"""

import asyncio
import html
import json
import os
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import ipywidgets
import numpy as np
import torch
from matplotlib.ticker import LogLocator

from skinlib.datasets.augment import UNDISTURBED
from skinlib.datasets.synthetic import synthetic_head
from skinlib.evaluate.metrics import row_l1
from skinlib.geometry import cotangents
from skinlib.graph import GraphConfig
from skinlib.head import Head, HeadError
from skinlib.losses import LossWeights, TermWeights, dirichlet
from skinlib.model import CriticConfig, ModelConfig
from skinlib.model.inputs import prepare
from skinlib.training import AS_WRITTEN, STATE, TermForms, TrainConfig, Trainer
from skinlib.training.checkpoint import replace_file
from skinlib.training.terms import D_S, D_U, Terms
from skinlib.views import scenes
from skinlib.views.picture import (
    ColourBar,
    Picture,
    new_figure,
    picture_grid,
    rasterise,
)
from skinlib.views.plots import OURS, SERIES

RUN_FILE = "lab.json"
HEADS = 5  # that are trained on; the last one never has labels
JUDGE_EVERY = 5  # steps between two looks at the held-out head
# For each term, the fields of `TermForms` in which the source's form differs from ours.
FORMS = {
    "supervised": (),  # L_sup itself, see `LossWeights.seed`
    "adversarial_s": ("signs",),
    "adversarial_u": ("positives",),
    "consistency": ("consistency",),
    "physical": ("smooth", "joint"),
    "penalty": ("per_vertex",),
}
SCORES = tuple(f"{critic}_{kind}" for critic in (D_S, D_U) for kind in ("real", "fake"))
CURVES = ("row_l1", "held_out", *(f.name for f in fields(TermWeights)), *SCORES)
SHOWS = ("all bones", "one bone", "error", "opinion of D_s", "opinion of D_u")
WHICH = ("labelled", "unlabelled", "held out")


@dataclass(frozen=True)
class LabSettings(TermWeights):
    """What can be turned while a run goes on; alpha to epsilon are the source's."""

    balance: float = 0.1  # lambda, of the cosine in the source's L_sup
    penalty: float = 10.0  # lambda_gp, of the critics' gradient penalty
    critics: bool = True  # without them nobody judges, and beta and gamma do nothing
    labelled: int = 1  # how many of the heads come with an artist's weights
    as_written: tuple[str, ...] = ()  # names of `FORMS` that run as the source writes

    def __post_init__(self):
        if not any(asdict(self.weights).values()):
            raise ValueError("every weight that counts is 0: nothing would be learnt")
        if not 1 <= self.labelled < HEADS:
            raise ValueError(f"labelled is {self.labelled}: use 1 to {HEADS - 1}")
        if unknown := set(self.as_written) - set(FORMS):
            raise ValueError(f"as_written has {sorted(unknown)}: use {list(FORMS)}")
        # In one order, so that equal settings are equal.
        written = tuple(name for name in FORMS if name in self.as_written)
        object.__setattr__(self, "as_written", written)

    @property
    def weights(self) -> TermWeights:
        """Alpha to epsilon; those of critics that are off are 0."""
        given = {f.name: getattr(self, f.name) for f in fields(TermWeights)}
        if not self.critics:
            given |= {D_S: 0.0, D_U: 0.0}
        return TermWeights(**given)

    def config(self, base: TrainConfig) -> TrainConfig:
        """The training configuration that these settings mean."""
        written = [field for name in self.as_written for field in FORMS[name]]
        source = LossWeights(0.0, 0.0, seed=1.0, balance=self.balance)
        return replace(
            base,
            terms=self.weights,
            penalty=self.penalty,
            forms=TermForms(**{field: getattr(AS_WRITTEN, field) for field in written}),
            loss=source if "supervised" in self.as_written else LossWeights(),
        )


class _Terms(Terms):
    """The terms of a run, with nothing guessed for a label."""

    def __init__(self, config, model, critics):
        super().__init__(config, model, critics)
        self.whole = True
        self.edges: dict[bytes, list[torch.Tensor]] = {}

    def losses(self, sample, rng):
        result = super().losses(sample, rng)
        if not sample.labelled:
            del result.shown["supervised"]  # counts 0, see `pseudo` below
        return result

    def _smooth(self, predicted, points, faces, mesh):
        if self.config.forms.smooth != "dirichlet":
            return super()._smooth(predicted, points, faces, mesh)
        key = points.tobytes()  # heads are never disturbed here: the same few
        if key not in self.edges:
            self.edges[key] = [torch.from_numpy(a) for a in cotangents(points, faces)]
        return dirichlet(predicted, *self.edges[key])


class _Trainer(Trainer):
    """A trainer whose settings may change between two steps."""

    def __init__(self, config: TrainConfig, heads: list[Head]):
        # It looks into `out` for an older run: there is none in the null device.
        bare = [head.replace(weights=None) for head in heads]
        super().__init__(config, heads, os.devnull, bare, validation=[])
        self.terms = _Terms(config, self.model, self.critics)
        self.heads = heads
        self._pool = ThreadPoolExecutor(config.threads)

    def apply(self, settings: LabSettings) -> None:
        self.config = self.terms.config = settings.config(self.config)
        self.terms.critics = self.critics if settings.critics else {}
        self.labelled = self.heads[: settings.labelled]
        self.unlabelled = [
            head.replace(weights=None) for head in self.heads[settings.labelled :]
        ]

    def reopen(self, folder: Path) -> None:
        self.out = folder
        self._resume()

    def _draw(self, draw, rng):
        """A labelled and an unlabelled head in turn, so that each step has all terms.

        A graph keeps its key when its head loses or gains its labels.
        """
        turn, odd = divmod(draw, 2)
        count = len(self.labelled)
        if not odd:
            head = self.labelled[turn % count]
            graph = self._graph(turn % count, head)
            return head, graph, True, np.ones(len(graph), bool)
        place = turn % len(self.unlabelled)
        head = self.unlabelled[place]
        graph = self._graph(count + place, head)
        head = head.replace(weights=self._guess(head, graph))
        return head, graph, False, np.zeros(len(graph), bool)


# So small that a step takes less than a blink.
NETWORK = ModelConfig(
    mesh_width=32,
    bone_width=32,
    blocks=1,
    points=4,
    tree_layers=1,
    pair_width=16,
    heads=2,
    graph=GraphConfig(neighbours=8, nearest=4),
)


def lab_config(seed: int = 0) -> TrainConfig:
    """The part of a run's configuration that stays as it is."""
    return TrainConfig(
        steps=10**6,  # no end in sight, so that the learning rate stays the same
        optimizer="adamw",
        warmup=10,
        ema=0.9,
        seed=seed,
        threads=2,
        unlabelled_share=0.5,
        unlabelled_start=0.0,
        pseudo=0.0,  # as in the source: L_sup is for labelled heads only
        terms=TermWeights(),
        critic=CriticConfig(width=16, bone_width=8, neighbours=6),
        model=NETWORK,
        augment=UNDISTURBED,
    )


class LabRun:
    """A run of the lab: heads, network, critics, curves, pictures; no widget.

    Attributes:
        settings: what counts from the next step on; `set` changes it.
        curves: for each of `CURVES` a value a step; NaN where there was none.
        heads: HEADS training heads and a held-out one; all weights are known here,
            whether the run is shown them or not.

    Raises:
        ValueError: settings that make no sense, see `LabSettings`.

    >>> run = LabRun(seed=1, labelled=2)
    >>> run.set(physical=0.0, critics=False)
    >>> run.settings.labelled, run.steps
    (2, 0)
    """

    def __init__(self, seed: int = 0, vertices: int = 600, bones: int = 10, **settings):
        self.seed, self.vertices, self.bones = seed, vertices, bones
        self.settings = LabSettings(**settings)
        names = [f"head {i + 1}" for i in range(HEADS)] + ["held-out head"]
        self.heads = [
            synthetic_head(seed * 100 + i, vertices=vertices, bones=bones).replace(
                name=name
            )
            for i, name in enumerate(names)
        ]
        self.curves: dict[str, list[float]] = {name: [] for name in CURVES}
        self._inputs = {}
        self._applied: LabSettings | None = None
        self._trainer = _Trainer(lab_config(seed), self.heads[:HEADS])

    def __repr__(self) -> str:
        return f"<LabRun seed {self.seed}, {self.steps} steps>"

    @property
    def steps(self) -> int:
        """Steps done."""
        return self._trainer.steps_done

    def again(self) -> "LabRun":
        """The same heads, seed and settings, from step 0."""
        settings = {f.name: getattr(self.settings, f.name) for f in fields(LabSettings)}
        return LabRun(self.seed, self.vertices, self.bones, **settings)

    def set(self, **changes) -> None:
        """Change settings, from the next step on; fields of `LabSettings`."""
        self.settings = replace(self.settings, **changes)

    def step(self, count: int = 1) -> None:
        """Train so many steps and note their numbers.

        Raises:
            FloatingPointError: a gradient is not finite; nothing has moved.
        """
        for _ in range(count):
            self._apply()
            means = self._trainer.step()
            if (self.steps - 1) % JUDGE_EVERY == 0:
                means["held_out"] = float(self.errors("held out").mean())
            for name, curve in self.curves.items():
                curve.append(means.get(name, float("nan")))

    def _apply(self) -> None:
        if self._applied != self.settings:
            self._applied = self.settings
            self._trainer.apply(self._applied)

    def last(self, name: str) -> float:
        """The newest number of a curve; NaN when there is none."""
        known = [v for v in self.curves[name][-2 * JUDGE_EVERY :] if np.isfinite(v)]
        return known[-1] if known else float("nan")

    def level(self, name: str, count: int = 10) -> float:
        """Mean of a curve's last steps, which jumps less than the last one."""
        recent = np.array(self.curves[name][-count:], np.float64)
        return float(np.nanmean(recent)) if np.isfinite(recent).any() else float("nan")

    # -- what the network says now -------------------------------------------------

    def head(self, which: str = "labelled") -> Head:
        """One of WHICH: the first labelled head, the unlabelled or the held-out one."""
        places = dict(zip(WHICH, (0, HEADS - 1, HEADS), strict=True))
        if which not in places:
            raise ValueError(f"which is {which!r}: use one of {', '.join(WHICH)}")
        return self.heads[places[which]]

    @torch.no_grad()
    def weights(self, which: str = "labelled") -> np.ndarray:
        """(V, J) skin weights of a head, by the averaged network."""
        return self._trainer.average(*self._prepared(which)).numpy()

    def errors(self, which: str = "labelled") -> np.ndarray:
        """(V,) row-L1 of each vertex, 0 .. 2."""
        return row_l1(self.weights(which), self.head(which).weights)

    def opinion(self, critic: str, which: str = "labelled") -> tuple[np.ndarray, float]:
        """What a critic thinks of the predicted weights.

        Args:
            critic: `adversarial_s` for D_s or `adversarial_u` for D_u.

        Returns:
            (V,) how steeply its score rises with each vertex's row, as a length per
            share of the vertices: where it sees most to improve; and the score.
        """
        mesh, skeleton = self._prepared(which)
        judge = self._trainer.critics[critic].on(mesh, skeleton)
        with torch.no_grad():
            weights = self._trainer.average.node_logits(mesh, skeleton).softmax(dim=1)
        score = judge(weights.requires_grad_())
        (slope,) = torch.autograd.grad(score, weights)
        # A row keeps its sum, so only what is not common to all bones can be followed.
        slope = slope - slope.mean(dim=1, keepdim=True)
        steep = len(slope) * torch.linalg.vector_norm(slope, dim=1)
        return steep[mesh.node_of_vertex].numpy(), score.item()

    def _prepared(self, which: str):
        if which not in self._inputs:
            self._inputs[which] = prepare(
                self.head(which), self._trainer.model.config.graph
            )
        return self._inputs[which]

    # -- pictures ------------------------------------------------------------------

    def picture(
        self,
        show: str = "all bones",
        *,
        bone: str = "jaw",
        which: str = "labelled",
        jaw: float = 0.0,
        beside: "LabRun | None" = None,
        size: tuple[int, int] = (300, 360),
    ) -> Picture:
        """A head in the colours of what `show` says, and of a reference run beside it.

        Args:
            show: one of SHOWS. bone: for "one bone". which: one of WHICH.
            jaw: 0 shut .. 1 open, by the weights that are shown.
        """
        if show not in SHOWS:
            raise ValueError(f"show is {show!r}: use one of {', '.join(SHOWS)}")
        runs = {"this run": self} | ({"reference": beside} if beside else {})
        head, names, skins, values = self.head(which), [], [], []
        if show in SHOWS[:2]:
            names, skins = ["artist"], [head.weights]
        bar = ColourBar("skin weight, 0 to 1")
        for name, run in runs.items():
            skins.append(run.weights(which))
            error = row_l1(skins[-1], head.weights)
            names.append(f"{name}: row-L1 {error.mean():.2f}")
            if show == "error":
                values.append(error)
                bar = ColourBar("row-L1 of a vertex, 0 to 2", 0.0, 2.0)
            elif show not in SHOWS[:2]:
                steep, score = run.opinion(D_S if show.endswith("s") else D_U, which)
                values.append(steep)
                names[-1] = f"{name}: score {score:.2f}"
        if show == "one bone":
            column = scenes._bone_id(head.skeleton, bone)
            values = [skin[:, column] for skin in skins]
        elif values and show != "error":
            high = max(float(np.quantile(steep, 0.99)) for steep in values)
            bar = ColourBar("slope of the score", 0.0, high or 1.0)
        if values:
            colours = [scenes.colour_by_value(v, bar.low, bar.high) for v in values]
        else:
            colours = [scenes.colour_by_bone(skin, head.skeleton) for skin in skins]
        images = [
            scenes.render(
                head,
                colour,
                vertices=scenes.pose_vertices(head, skin, {"jaw_open": jaw}),
                size=size,
            )
            for skin, colour in zip(skins, colours, strict=True)
        ]
        what = f"the bone {bone}" if show == "one bone" else show
        return picture_grid(
            images,
            names,
            title=f"{head.name} ({which}): {what}" if head.name != which else what,
            colour_bar=bar if values else None,
        )

    def curves_picture(self, beside: "LabRun | None" = None) -> Picture:
        """Every term over the steps; a reference run as dashed lines."""
        scores = {"artist": "real", "network": "fake"}
        panels = {
            "row-L1": {"labelled": "row_l1", "held out": "held_out"},
            "α supervised": {"": "supervised"},
            "β scores by D_s": {k: f"{D_S}_{v}" for k, v in scores.items()},
            "γ scores by D_u": {k: f"{D_U}_{v}" for k, v in scores.items()},
            "δ consistency": {"": "consistency"},
            "ε physical": {"": "physical"},
        }
        with new_figure(7.6, 4.0) as figure:
            for axes, (title, names) in zip(
                figure.subplots(2, 3).flat, panels.items(), strict=True
            ):
                for run, dash in ((beside, "--"), (self, "-")):
                    for (label, name), colour in zip(
                        names.items() if run else (), (OURS, SERIES[0]), strict=False
                    ):
                        steps, values = _smooth(run.curves[name])
                        axes.plot(steps, values, dash, color=colour, linewidth=1.5,
                                  label=label if run is self else "")  # fmt: skip
                axes.set_title(title, weight="bold")
                axes.grid(axis="y", color="#e5e7eb", linewidth=0.7)
                if len(names) > 1:
                    axes.legend()
                if title.startswith("ε"):
                    axes.set_yscale("log")  # it starts ten times as high as it ends
                    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
                    axes.yaxis.set_major_formatter("{x:g}")
                    axes.yaxis.set_minor_formatter("")
                elif title.startswith(("row", "δ")):
                    axes.set_ylim(bottom=0)
            note = "steps; means of ten"
            note += "; dashed: the reference" if beside else ""
            return rasterise(figure, "Every term over the steps", note)

    # -- keeping -------------------------------------------------------------------

    def save(self, folder: str | Path) -> Path:
        """Write the run into a folder: parameters, optimizers, settings and curves."""
        self._apply()
        folder = Path(folder)
        self._trainer.out = folder
        folder.mkdir(parents=True, exist_ok=True)
        known = {
            name: [None if np.isnan(value) else value for value in curve]
            for name, curve in self.curves.items()
        }
        content = {
            "seed": self.seed,
            "vertices": self.vertices,
            "bones": self.bones,
            "settings": asdict(self.settings),
            "curves": known,
        }
        self._trainer.save()
        replace_file(folder / RUN_FILE, json.dumps(content).encode())
        return folder

    @classmethod
    def load(cls, folder: str | Path) -> "LabRun":
        """A run that `save` wrote; it goes on as if it had never been away.

        Raises:
            HeadError: there is none, or its files do not belong together.
        """
        path = Path(folder) / RUN_FILE
        if not path.is_file() or not (path.parent / STATE).is_file():
            raise HeadError(
                "run", "there is no saved run", "give a folder that Save wrote", path
            )
        try:
            content = json.loads(path.read_text())
            curves = content.pop("curves")
            settings = content.pop("settings")
            settings["as_written"] = tuple(settings["as_written"])
            run = cls(**content, **settings)
            run.curves = {
                name: [float("nan") if v is None else float(v) for v in curves[name]]
                for name in CURVES
            }
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise HeadError(
                "run", f"a damaged file ({error})", "save the run again", path
            ) from error
        run._apply()
        run._trainer.reopen(Path(folder))
        if any(len(curve) != run.steps for curve in run.curves.values()):
            raise HeadError(
                "run",
                "curves and parameters are of different steps",
                "save the run again",
                path,
            )
        return run


def _smooth(curve: list[float], count: int = 10) -> tuple[np.ndarray, np.ndarray]:
    """Steps that have a value, and there the mean over the last `count` steps."""
    values = np.array(curve, np.float64)
    known = np.flatnonzero(np.isfinite(values))
    sums = np.concatenate([[0.0], np.cumsum(values[known])])
    ends = np.arange(1, len(sums))
    starts = np.searchsorted(known, known - count, side="right")
    return known + 1, (sums[ends] - sums[starts]) / (ends - starts)


# ---- the widget

REDRAW_SECONDS = 0.4  # between two pictures, at least
FAILURES = (ValueError, FloatingPointError, OSError)  # what a reader can cause
GREEK = dict(zip((f.name for f in fields(TermWeights)), "αβγδε", strict=True))
WRITTEN = {f"{name}_as_written": name for name in FORMS}
BUTTONS = {
    "Run": "train until Pause",
    "Pause": "hold; the sliders keep their values",
    "Step": "one step",
    "Reset": "begin again, with these settings",
    "Keep": "keep this run as the reference, begin a new one beside it",
    "Forget": "the reference",
    "Save": "write this run into the folder",
    "Open": "go on with the run in the folder",
}


class LossLab(ipywidgets.VBox):
    """A `LabRun` with a slider on every weight, and buttons to run and to keep it.

    Steps and pictures take turns in the event loop of the notebook's kernel: a slider
    waits for one step at most, and VTK's window stays in the thread that opened it.

    Attributes:
        run: the run that goes on. reference: a run to compare with, or None.
        controls: sliders, boxes and menus by name. buttons: by their text.
        picture, curves: what is shown now.
    """

    def __init__(self, run: LabRun | None = None):
        self.run = run or LabRun()
        self.reference: LabRun | None = None
        self.picture = self.curves = None
        self._task: asyncio.Task | None = None
        self._milliseconds = float("nan")
        self._turned = _setting_controls(self.run.settings)
        self._looks = _look_controls(self.run)
        self._folder = ipywidgets.Text("runs/lab", description="folder", **_look(240))
        self.controls = {**self._turned, **self._looks, "folder": self._folder}
        self.buttons = {
            name: ipywidgets.Button(
                description=name, tooltip=tip, layout={"width": "80px"}
            )
            for name, tip in BUTTONS.items()
        }
        self._head, self._chart = (
            # Side by side where there is room, below each other where there is not.
            ipywidgets.Image(
                format="jpeg",
                layout={
                    "flex": "1 1 560px",
                    "min_width": "320px",
                    "max_width": "760px",
                    "height": "auto",
                    "align_self": "flex-start",
                },
            )
            for _ in range(2)
        )
        self._status, self._message = ipywidgets.HTML(), ipywidgets.HTML()
        for name, button in self.buttons.items():
            self._connect(button.on_click, getattr(self, f"_press_{name.lower()}"))
        for control in self._turned.values():
            self._connect(control.observe, self._hand_over, names="value")
        for control in self._looks.values():
            self._connect(control.observe, self.draw, names="value")
        super().__init__(self._arranged())
        self.draw()

    def __repr__(self) -> str:
        return f"<LossLab of {self.run!r}>"

    @property
    def running(self) -> bool:
        """Whether steps are being taken."""
        return self._task is not None

    def draw(self) -> None:
        """Show the present state."""
        looks = {name: control.value for name, control in self._looks.items()}
        self.picture = self.run.picture(**looks, beside=self.reference)
        self.curves = self.run.curves_picture(self.reference)
        self._head.value, self._chart.value = self.picture.jpeg(), self.curves.jpeg()
        self._status.value = (
            f"<b>{'running' if self.running else 'paused'}</b>, step {self.run.steps}"
            f"&emsp;{self._milliseconds:.0f} ms a step"
            f"&emsp;row-L1: labelled {self.run.last('row_l1'):.3f},"
            f" held out {self.run.last('held_out'):.3f}"
        )

    # -- buttons -------------------------------------------------------------------

    def _press_run(self) -> None:
        if not self.running:
            self._hand_over()
            self._task = asyncio.get_running_loop().create_task(self._go_on())

    def _press_pause(self) -> None:
        self._hold()
        self.draw()

    def _press_step(self) -> None:
        self._hold()
        self._hand_over()
        self._take_step()
        self.draw()

    def _press_reset(self) -> None:
        self._begin(self.run.again())

    def _press_keep(self) -> None:
        self.reference = self.run
        self._begin(self.run.again())

    def _press_forget(self) -> None:
        self.reference = None
        self.draw()

    def _press_save(self) -> None:
        folder = self.run.save(self._folder.value)
        self._message.value = f"saved in {html.escape(str(folder))}"

    def _press_open(self) -> None:
        run = LabRun.load(self._folder.value)
        self._hold()
        values = _values(run.settings)
        for name, control in self._turned.items():
            control.value = values[name]
        self._begin(run)

    # -- the run -------------------------------------------------------------------

    def _hand_over(self) -> None:
        """What the controls say counts from the next step on."""
        values = {name: control.value for name, control in self._turned.items()}
        written = tuple(WRITTEN[name] for name in WRITTEN if values.pop(name))
        self.run.set(**values, as_written=written)

    def _take_step(self) -> None:
        began = time.perf_counter()
        self.run.step()
        taken = 1000 * (time.perf_counter() - began)
        before = self._milliseconds
        self._milliseconds = 0.9 * before + 0.1 * taken if before > 0 else taken

    async def _go_on(self) -> None:
        """Steps until somebody holds them or one fails."""
        due = 0.0
        try:
            while True:
                self._take_step()
                if (began := time.perf_counter()) > due:
                    self.draw()
                    drawing = time.perf_counter() - began
                    due = time.perf_counter() + max(REDRAW_SECONDS, 2 * drawing)
                await asyncio.sleep(0.002)  # here sliders and buttons are heard
        except FAILURES as error:
            self._task = None
            self.draw()
            self._say(error)

    def _hold(self) -> None:
        if self._task is not None:
            self._task.cancel()
            self._task = None

    def _begin(self, run: LabRun) -> None:
        self._hold()
        self.run = run
        self.draw()

    # -- around it -----------------------------------------------------------------

    def _connect(self, register: Callable, action: Callable, **options) -> None:
        """Call `action` on an event; what it has to complain about is shown."""

        def answer(_) -> None:
            self._message.value = ""
            try:
                action()
            except Exception as error:
                # An exception in a browser's event reaches only the server's log.
                self._say(error)
                if not isinstance(error, FAILURES):
                    raise

        register(answer, **options)

    def _say(self, error: Exception) -> None:
        self._message.value = f"<b>{html.escape(str(error))}</b>"

    def _arranged(self) -> list[ipywidgets.Widget]:
        wrap = {"flex_flow": "row wrap"}
        with_form = [
            ipywidgets.HBox([self._turned[name], self._turned[written]])
            for written, name in WRITTEN.items()
            if name != "penalty"
        ]
        others = [
            ipywidgets.HBox(
                [self._turned["penalty"], self._turned["penalty_as_written"]]
            ),
            *(self._turned[name] for name in ("balance", "labelled", "critics")),
        ]
        desk = ipywidgets.Box(
            [
                ipywidgets.VBox(with_form),
                ipywidgets.VBox(others),
                ipywidgets.VBox(list(self._looks.values())),
            ],
            layout=wrap,
        )
        buttons = ipywidgets.Box([*self.buttons.values(), self._folder], layout=wrap)
        screen = ipywidgets.Box([self._chart, self._head], layout=wrap)
        return [desk, buttons, self._status, self._message, screen]


def _look(width: int) -> dict:
    return {
        "style": {"description_width": "110px"},
        "layout": {"width": f"{width}px"},
    }


def _values(settings: LabSettings) -> dict:
    """The values of the controls that stand for settings."""
    values = {f.name: getattr(settings, f.name) for f in fields(LabSettings)}
    written = values.pop("as_written")
    return values | {name: form in written for name, form in WRITTEN.items()}


def _setting_controls(settings: LabSettings) -> dict[str, ipywidgets.Widget]:
    values = _values(settings)

    def slider(name: str, text: str, high: float, step: float):
        kind = ipywidgets.IntSlider if name == "labelled" else ipywidgets.FloatSlider
        low = 1 if name == "labelled" else 0
        return kind(values[name], min=low, max=high, step=step, description=text,
                    **_look(320))  # fmt: skip

    controls = {
        name: slider(name, f"{letter} {name}".replace("adversarial_", "D_"), 2.0, 0.05)
        for name, letter in GREEK.items()
    }
    controls["balance"] = slider("balance", "λ cosine", 2.0, 0.1)
    controls["penalty"] = slider("penalty", "λ_gp penalty", 20.0, 1.0)
    controls["labelled"] = slider("labelled", "labelled heads", HEADS - 1, 1)
    controls["critics"] = ipywidgets.Checkbox(
        values["critics"], description="critics on", **_look(320)
    )
    for name in WRITTEN:
        controls[name] = ipywidgets.Checkbox(
            values[name], description="as written", indent=False,
            layout={"width": "100px"},
        )  # fmt: skip
    return controls


def _look_controls(run: LabRun) -> dict[str, ipywidgets.Widget]:
    """What of the run is looked at; the names are those of `LabRun.picture`."""
    shared = set.intersection(*(set(run.head(w).skeleton.names) for w in WHICH))
    return {
        "show": ipywidgets.Dropdown(options=SHOWS, description="show", **_look(260)),
        "bone": ipywidgets.Dropdown(
            options=sorted(shared), value="jaw", description="bone", **_look(260)
        ),
        "which": ipywidgets.Dropdown(options=WHICH, description="head", **_look(260)),
        "jaw": ipywidgets.FloatSlider(
            0.0, min=0, max=1, step=0.1, description="open the jaw",
            continuous_update=False, **_look(260),
        ),
    }  # fmt: skip


# ---- the lab as a page of its own


def serve(port: int = 8866, browser: bool = True) -> None:
    """Show a `LossLab` as a web page of this machine, until Ctrl-C.

    Each visitor gets a lab of their own. Only this machine can reach it.

    Raises:
        HeadError: Voila is not installed.
    """
    try:
        from voila.app import Voila
    except ModuleNotFoundError as error:
        raise HeadError(
            "lab", "Voila is not installed", "pip install 'skinlib[notebooks]'"
        ) from error
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "loss_lab.ipynb"
        page.write_text(json.dumps(_page()))
        options = [f"--port={port}", "--Voila.ip=127.0.0.1"]
        options += [] if browser else ["--no-browser"]
        Voila.launch_instance([str(page), *options])


def _page() -> dict:
    """A notebook of one cell; a run is saved below the folder we stand in."""
    source = (
        f"import os; os.chdir({str(Path.cwd())!r})\n"
        "from skinlib.views.lab import LossLab; LossLab()"
    )
    cell = {"cell_type": "code", "id": "lab", "metadata": {}, "source": source}
    kernel = {"name": "python3", "display_name": "Python 3"}
    return {
        "cells": [cell | {"execution_count": None, "outputs": []}],
        "metadata": {"kernelspec": kernel},
        "nbformat": 4,
        "nbformat_minor": 5,
    }
