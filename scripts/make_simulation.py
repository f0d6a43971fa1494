"""Make data_samples/skirt_walks.npz again: a small skirt, simulated in random walks.

    python scripts/make_simulation.py

The file holds no body and no motion: `walk` makes them from a row of numbers. Another
machine, or other versions than those in constraints.txt, may move the last bits of the
simulation, and cloth lets them grow.
"""

from pathlib import Path

import numpy as np
import tyro
from make_samples import write_sums
from tqdm import tqdm

from skinlib.garments.body import read_body
from skinlib.garments.motion import walk
from skinlib.garments.patterns import skirt
from skinlib.garments.simulation import SimulationConfig, Simulator
from skinlib.io import atomic

PATTERN = {"rings": 13, "segments": 24}
TRAIN, HELD_OUT = 13, 4
FPS, SECONDS, SEED = 15.0, 3.0, 16
RANGES = {
    "speed": (0.6, 1.4),  # cycles a second
    "stride": (12, 38),  # degrees
    "crouch": (0, 35),  # degrees
    "turn_rate": (-80, 80),  # degrees a second
}
STEP = 5e-4  # metres: positions are stored as so many of these


def make_simulation(out: Path = Path(__file__).parents[1] / "data_samples") -> None:
    """Write the walks and the SHA256SUMS into the folder `out`."""
    body = read_body().head
    garment = skirt(body, **PATTERN)
    simulator = Simulator(garment, body, SimulationConfig())
    rest = simulator.settled()
    rng = np.random.default_rng(SEED)
    rows, posed = [], []
    for _ in tqdm(range(TRAIN + HELD_OUT), unit="walk"):
        amounts = {name: rng.uniform(*ends) for name, ends in RANGES.items()}
        motion = walk(body.skeleton, SECONDS, fps=FPS, arm_raise=40, **amounts)
        rows.append(list(amounts.values()))
        posed.append(np.stack(list(simulator.frames(motion, rest))))
    with atomic(out / "skirt_walks.npz") as file:
        np.savez_compressed(
            file,
            vertices=garment.vertices,
            faces=garment.faces,
            pinned=garment.pinned,
            rest=rest,
            walks=np.array(rows),
            names=np.array(list(RANGES)),
            fps=FPS,
            seconds=SECONDS,
            frames=np.array([len(walk) for walk in posed]),
            posed=np.round(np.concatenate(posed) / STEP).astype(np.int16),
            step=STEP,
            held_out=HELD_OUT,
        )
    write_sums(out)


if __name__ == "__main__":
    tyro.cli(make_simulation)
