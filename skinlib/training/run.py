"""A training run that goes on exactly where it stopped: what all of Part II share."""

import time
from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np
import torch
from torch import nn
from tqdm.auto import tqdm

from skinlib.training.checkpoint import STATE
from skinlib.training.state import read_state, uninterrupted, write_state

RECORD = 100  # steps from one entry of the history to the next


class Run(ABC):
    """What all training runs have in common: they go on exactly where they stopped.

    One step is `step()`, its end `_finish()`, and what makes it the same run
    `_identity()`. `config` has steps, learning_rate, threads and save_seconds.
    """

    network: nn.Module
    what = "garment"  # is trained, for the progress bar

    def _start(
        self,
        config,
        out: str | Path,
        groups: list[dict],
        optimizer: type[torch.optim.Optimizer] = torch.optim.Adam,
    ) -> None:
        """Begin, or go on where it stopped.

        Args:
            groups: of parameters, for the optimizer; `scale` times the learning rate.
        """
        self.config, self.out = config, Path(out)
        self.parameters = list(self.network.parameters())
        self.optimizer = optimizer(groups)
        self.steps_done, self.seconds = 0, 0.0
        self.recent: dict[str, float] = {}  # running means of what a step tells
        self.history: list[dict] = []
        if (self.out / STATE).exists():
            self._resume()

    @abstractmethod
    def step(self) -> dict[str, float]:
        """One step."""

    def _update(self, told: dict[str, float]) -> None:
        """Change the parameters by their gradients, and remember what a step tells."""
        rate = self.config.learning_rate * self._fallen(
            self.steps_done / self.config.steps
        )
        for group in self.optimizer.param_groups:
            group["lr"] = rate * group.get("scale", 1.0)
        with uninterrupted():
            self.optimizer.step()
            self.steps_done += 1
            for name, value in told.items():
                before = self.recent.get(name, value)
                self.recent[name] = 0.98 * before + 0.02 * value
            if self.steps_done % RECORD == 0:
                self._look()
                self.history.append({"step": self.steps_done, **self.recent})

    def _fallen(self, done: float) -> float:
        """What is left of the learning rate, to 1 % along a cosine; `done`: 0 to 1."""
        return 0.01 + 0.99 * 0.5 * (1 + np.cos(np.pi * done))

    def _look(self) -> None:  # noqa: B027  # most runs have nothing to look at
        """Look at the network before an entry of the history is made."""

    @abstractmethod
    def _finish(self) -> nn.Module:
        """Keep what was trained, and return it."""

    @abstractmethod
    def _identity(self) -> dict:
        """What has to be the same for a run to be the same."""

    # -- the run -------------------------------------------------------------------

    def run(self) -> nn.Module:
        """Train to the last step and return the network."""
        self.out.mkdir(parents=True, exist_ok=True)
        saved = time.monotonic()
        threads = torch.get_num_threads()
        torch.set_num_threads(self.config.threads)
        try:
            with self._bar() as bar:
                while self.steps_done < self.config.steps:
                    began = time.monotonic()
                    self.step()
                    self.seconds += time.monotonic() - began
                    bar.update()
                    bar.set_postfix(self._shown(), refresh=False)
                    if time.monotonic() - saved > self.config.save_seconds:
                        self.save()
                        saved = time.monotonic()
        except KeyboardInterrupt:
            self.save()
            tqdm.write(f"Stopped; the same call goes on from {self.out / STATE}.")
            raise
        finally:
            torch.set_num_threads(threads)
        self.save()
        return self._finish()

    # -- what is shown and kept ----------------------------------------------------

    def _bar(self) -> tqdm:
        return tqdm(
            total=self.config.steps,
            initial=self.steps_done,
            desc=self.what,
            unit="step",
        )

    def _shown(self) -> dict[str, str]:
        return {name: f"{value:.4f}" for name, value in self.recent.items()}

    def save(self) -> None:
        """Write the state to resume from; a crash meanwhile leaves the older one."""
        progress = {
            "run": self._identity(),
            "steps_done": self.steps_done,
            "seconds": self.seconds,
            "recent": self.recent,
            "history": self.history,
        }
        write_state(self.out, {"network": self.network}, self._memory(), progress)

    def _resume(self) -> None:
        networks = {"network": self.network}
        progress = read_state(self.out, networks, self._memory(), self._identity())
        self.steps_done, self.seconds = progress["steps_done"], progress["seconds"]
        self.recent, self.history = progress["recent"], progress["history"]

    def _memory(self) -> list[tuple[nn.Parameter, dict]]:
        return [(p, self.optimizer.state[p]) for p in self.parameters]
