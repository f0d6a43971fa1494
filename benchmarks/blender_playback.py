"""Does Blender play a garment as we do? The largest distance between the two.

    python benchmarks/blender_playback.py checkpoints/t_shirt
    python benchmarks/blender_playback.py runs/virtual_bones/runs/hybrid --motion walk

Writes a trained garment in motion to a `.glb`, opens that in Blender, and compares each
vertex of the cloth in every ninth frame. Blender is found as `skinlib.blender` finds
it: on the PATH, or where SKINLIB_BLENDER says.
"""

import tempfile
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from skinlib.blender.run import run_script
from skinlib.garments.loose import is_loose, load_loose
from skinlib.garments.motion import MOTIONS
from skinlib.garments.outfit import load_outfit

EVERY = 9  # frames from one look to the next
# Runs inside Blender: saves each mesh as it is seen.
SCRIPT = """
import sys
import bpy
import numpy as np

source, target, fps, frames = sys.argv[-4:]
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.render.fps = int(fps)
bpy.ops.import_scene.gltf(filepath=source)
seen = {"version": np.array(bpy.app.version)}
for thing in [o for o in bpy.data.objects if o.type == "MESH" and o.vertex_groups]:
    seen[thing.name] = []
    for frame in map(int, frames.split(",")):
        scene.frame_set(frame)
        mesh = thing.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        points = np.zeros(3 * len(mesh.vertices), np.float32)
        mesh.vertices.foreach_get("co", points)
        place = np.array(thing.matrix_world)
        seen[thing.name].append(points.reshape(-1, 3) @ place[:3, :3].T + place[:3, 3])
np.savez(target, **seen)
"""


def main(
    run: tyro.conf.Positional[Path],
    *,
    motion: Literal["walk", "turn", "squat", "reach"] = "reach",
) -> None:
    """Play a garment in Blender and say how far off it is.

    Args:
        run: What `skinlib garment train` wrote, of either kind.
        motion: What it is worn in.
    """
    if is_loose(run):
        loose = load_loose(run)
        frames = MOTIONS[motion](loose.body.head.skeleton)
        ours, export = {loose.garment.name: loose.pose(frames)}, loose.export
    else:
        outfit, network = load_outfit(run)
        frames = MOTIONS[motion](outfit.body.head.skeleton)
        posed = outfit.pose(network, frames)
        pairs = zip(outfit.garments, outfit.parts, strict=True)
        ours = {garment.name: posed[:, part] for garment, part in pairs}

        def export(path, frames):
            outfit.export(path, network, frames)

    shown = range(0, len(frames), EVERY)
    with tempfile.TemporaryDirectory() as folder:
        script, file, seen = (Path(folder) / n for n in ("a.py", "a.glb", "a.npz"))
        script.write_text(SCRIPT)
        export(file, frames)
        listed = ",".join(map(str, shown))
        run_script(script, file, seen, f"{frames.fps:.0f}", listed)
        with np.load(seen, allow_pickle=False) as arrays:
            version = ".".join(map(str, arrays["version"]))
            for name, posed in ours.items():
                off = np.linalg.norm(arrays[name] - posed[list(shown)], axis=-1)
                print(
                    f"{name}: {1000 * off.max():.5f} mm at most, {len(shown)} frames "
                    f"of {motion}, Blender {version}"
                )


if __name__ == "__main__":
    tyro.cli(main)
