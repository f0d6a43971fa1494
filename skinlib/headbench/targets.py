"""What HeadBench asks of a method, and what it got."""

from dataclasses import dataclass

import numpy as np

from skinlib.headbench.bench import OTHERS, RATIO, TEMPLATE
from skinlib.headbench.suites import SUITES

UNTOUCHED = "untouched"
AUTOMATIC = ("Blender automatic", "bone heat (ours)")
# Largest error, in multiples of the untouched head's, by kind of suite.
RATIOS = {"remesh": 1.25, "order": 1.25, "pieces": 1.25, "skeleton": 1.5}


@dataclass(frozen=True)
class Target:
    """One line of the table: what is asked, and what was measured."""

    text: str
    bound: float
    measured: float
    at_least: bool = False  # a ratio to reach, instead of an error to stay under

    @property
    def met(self) -> bool:
        """Whether it is reached; what could not be measured is not."""
        if self.at_least:
            return self.measured >= self.bound
        return self.measured <= self.bound

    def row(self) -> tuple[str, str, str, str]:
        """Text, bound, measured, and whether it is met, as words."""
        sign = "≥" if self.at_least else "≤"
        verdict = "met" if self.met else "missed"
        measured = "not measured" if np.isnan(self.measured) else f"{self.measured:.3g}"
        return self.text, f"{sign} {self.bound:g}", measured, verdict


def targets(results: dict, ours: str) -> list[Target]:
    """Every target for the method `ours`; `results` are what `collect` returns."""

    def mean(suite: str, method: str, metric: str) -> float:
        numbers = results.get(suite, {}).get(method, {})
        value = numbers.get(metric, {}).get("mean")
        return float("nan") if value is None else value

    def best(suite: str, methods, metric: str = "row_l1_mean") -> float:
        return float(np.nanmin([mean(suite, m, metric) for m in methods] + [np.inf]))

    error = mean(UNTOUCHED, ours, "row_l1_mean")
    return [
        Target("unseen topology: row-L1", 0.05, error),
        Target(
            "unseen topology: deformation error, % of head height",
            0.15,
            mean(UNTOUCHED, ours, "deformation_mean"),
        ),
        Target(
            "times better than the best template copy",
            4,
            best(UNTOUCHED, TEMPLATE) / error,
            at_least=True,
        ),
        Target(
            "times better than automatic weights",
            20,
            best(UNTOUCHED, AUTOMATIC) / error,
            at_least=True,
        ),
        *(
            Target(
                f"{name}: row-L1 over the untouched head's",
                RATIOS[suite.kind],
                mean(name, ours, RATIO),
            )
            for name, suite in SUITES.items()
            if suite.kind in RATIOS and name in results
        ),
        Target(
            f"{OTHERS}: row-L1 over the best template copy's",
            1,
            mean(OTHERS, ours, "row_l1_mean") / best(OTHERS, TEMPLATE),
        ),
        # The metric is the difference from the artist's own.
        Target("lip bleed", 0.005, mean(UNTOUCHED, ours, "lip_bleed")),
        Target("lid bleed", 0.005, mean(UNTOUCHED, ours, "lid_bleed")),
    ]
