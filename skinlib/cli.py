"""The command line: `skinlib skin | train | evaluate | bench | garment | lab | ...`.

Each command is a function; its signature and docstring are its options and its help.
Everything slow to import is imported when a command runs, so that `--help` is quick.
"""

import json
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from tyro.conf import FlagCreatePairsOff, Positional, arg

from skinlib.head import Head, HeadError
from skinlib.paths import DEFAULT_CHECKPOINT

BAD_INPUT, INTERRUPTED = 2, 130

Input = Annotated[Positional[Path], arg(metavar="IN")]
Output = Annotated[Positional[Path], arg(metavar="OUT")]
Folder = Annotated[Path, arg(metavar="DIR")]
OptionalFolder = Annotated[Path | None, arg(metavar="DIR")]
Checkpoint = Annotated[str, arg(metavar="NAME|FILE")]
OptionalCheckpoint = Annotated[str | None, arg(metavar="NAME|FILE")]


def skin(
    source: Input,
    target: Output,
    *,
    checkpoint: Checkpoint = DEFAULT_CHECKPOINT,
    painted: OptionalFolder = None,
    max_influences: Annotated[int | None, arg(metavar="N")] = None,
    lock: Annotated[tuple[str, ...], arg(metavar="BONE ...")] = (),
    lock_vertices: Annotated[str | None, arg(metavar="ATTRIBUTE")] = None,
    smooth: Annotated[int, arg(metavar="N")] = 0,
    symmetric: bool = False,
    confidence: bool = False,
) -> None:
    """Compute skin weights for a head.

    IN holds one head and its bones: a .glb or .gltf as exported from Blender, Maya or
    Unreal, a .npz, or, with a Blender at hand, a .blend or .fbx. Any unit, any up-axis,
    1 to 200 bones with any names. It may be skinned already, or not at all. Everything
    else in IN is in OUT, too, unless one of them is a .npz: materials, blend shapes,
    other meshes, animations.

    For example:
      skinlib skin head.glb skinned.glb
      skinlib skin head.glb game.glb --max-influences 4 --symmetric
      skinlib skin painted.glb new.glb --lock jaw tongue
      skinlib skin painted.glb new.glb --lock-vertices _LOCKED --smooth 2
      skinlib skin guard.glb skinned.glb --painted cast
      skinlib skin head.glb skinned.glb --confidence
      skinlib skin head.blend skinned.blend

    Args:
        source: The head to skin.
        target: Where the skinned head goes; replaced when it exists.
        checkpoint: A shipped network, or a folder that `skinlib train` wrote.
        painted: Folder of skinned heads. Where IN has their mesh, sculpted anew, it
            takes over their weights; the network skins the rest.
        max_influences: At most N bones a vertex; all that matter when left out.
        lock: Bones whose weights in IN stay exactly as they are painted.
        lock_vertices: So do the vertices where this attribute of IN is above 0.5, such
            as _LOCKED from Blender, or the field `locked` of a .npz.
        smooth: Smooth N times along the surface, never from lip to lip, and prune. It
            calms noise, and blurs what is painted well.
        symmetric: Same weights on the left and on the right, where the mesh has both;
            where one side is locked, the other follows it.
        confidence: Colour the vertices of OUT, white where the weights are right for
            sure, red where to look before you ship; _CONFIDENCE has the number, 0 to 1.
    """
    from skinlib.datasets.folder import load_folder
    from skinlib.gltf import CONFIDENCE, MAX_ELEMENTS
    from skinlib.io import check_target, read_head, read_vertex_mask, write_head
    from skinlib.model.confidence import (
        colours,
        load_calibration,
        predict_with_confidence,
    )
    from skinlib.painting import finish
    from skinlib.training import load_model
    from skinlib.training.propagation import Propagation

    check_target(target)
    head = read_head(source, weights=bool(lock or lock_vertices))
    count, bones = len(head.vertices), len(head.skeleton)
    if count * bones > MAX_ELEMENTS:
        raise HeadError(
            "weights",
            f"{count:,} vertices times {bones:,} bones are too many",
            f"stay below {MAX_ELEMENTS:,} weights: export the head alone",
            source,
        )
    bone_ids = _locked_bones(head, lock, source)
    vertices = read_vertex_mask(source, lock_vertices) if lock_vertices else None
    if (lock or lock_vertices) and head.weights is None:
        raise HeadError(
            "--lock" if lock else "--lock-vertices",
            "the head has no weights that could be kept",
            "lock bones and vertices of a head that is skinned already",
            source,
        )
    if max_influences is not None and max_influences < 1:
        raise HeadError(
            "--max-influences", f"{max_influences}", "give 1 or more", source
        )
    if smooth < 0:
        raise HeadError("--smooth", f"{smooth}", "give 0 or more", source)
    model, note, paint = load_model(checkpoint), "", {}
    if confidence:
        calibration = load_calibration(checkpoint)
        weights, sure = predict_with_confidence(model, head, calibration)
    else:
        weights, sure = model.predict(head), np.ones(count)
    if painted:
        rows, known = Propagation(load_folder(painted)).rows(head)
        weights, sure = np.where(known[:, None], rows, weights), np.maximum(sure, known)
        note = f"\n{known.mean():.0%} of the vertices are as in {painted}"
    if confidence:
        sure = sure if vertices is None else np.maximum(sure, vertices)
        paint = {"colours": colours(sure), "attributes": {CONFIDENCE: sure}}
        note += f"\n{(sure < 0.5).mean():.0%} of the vertices are rather wrong than not"
    weights = finish(
        head,
        weights,
        locked_bones=bone_ids,
        locked_vertices=vertices,
        smooth=smooth,
        symmetric=symmetric,
        max_influences=max_influences,
        file=source,
    )
    whole = source.suffix.lower() in {".glb", ".blend", ".fbx"}
    whole &= target.suffix.lower() != ".npz"
    skinned = head.replace(weights=weights)
    write_head(target, skinned, source=source if whole else None, **paint)
    used = int((weights > 0).sum(axis=1).max())
    print(
        f"{target}: {count:,} vertices, {bones:,} bones, at most {used} a vertex{note}"
    )


def _locked_bones(head: Head, names: Sequence[str], file: Path) -> list[int]:
    unknown = [name for name in names if name not in head.skeleton.names]
    if unknown:
        raise HeadError(
            "--lock",
            f"no bone is called {', '.join(map(repr, unknown))}",
            f"choose from {', '.join(head.skeleton.names)}",
            file,
        )
    return [head.skeleton.names.index(name) for name in names]


def train(
    *,
    labelled: Folder,
    out: Folder,
    unlabelled: OptionalFolder = None,
    validation: OptionalFolder = None,
    start: OptionalCheckpoint = None,
    remeshed: Annotated[int, arg(metavar="N")] = 0,
    minutes: Annotated[float, arg(metavar="M")] = 30.0,
    seed: Annotated[int, arg(metavar="S")] = 0,
    device: Annotated[str, arg(metavar="D")] = "cpu",
    threads: Annotated[int, arg(metavar="T")] = min(2, os.cpu_count() or 1),
) -> None:
    """Train a network on heads that you have skinned.

    The best network so far is kept in OUT all the time. Ctrl-C stops; the same command
    goes on where it stopped. Twenty heads are a start; heads with different meshes
    teach more than many sculpts of one mesh.

    For example:
      skinlib train --labelled my_heads --out runs/mine --start heads --minutes 10
      skinlib train --labelled painted --unlabelled bare --out runs/cast --start heads
      skinlib train --labelled my_heads --out runs/scratch --minutes 30
      skinlib skin new.glb skinned.glb --checkpoint runs/mine

    Args:
        labelled: Folder of skinned heads (.glb, .gltf, .npz).
        out: Folder that the network is written to; made when there is none.
        unlabelled: Folder of heads without weights, best those that you want to skin.
            Where their mesh is that of a labelled head, its weights are taken over.
        validation: Folder of skinned heads to judge by; else some meshes of LABELLED.
        start: Begin with this network and adapt it, instead of from nothing.
        remeshed: Learn from N copies of each head, too, which have other meshes: for
            heads to come whose meshes are unlike yours. Costs some time.
        minutes: How long to train.
        seed: Same seed, same start.
        device: Where to compute, such as cpu or cuda.
        threads: CPU cores to use.
    """
    from skinlib import training
    from skinlib.datasets.folder import load_folder

    if not 0 < minutes < float("inf"):
        raise HeadError("--minutes", f"{minutes:g}", "give more than 0")
    if threads < 1:
        raise HeadError("--threads", f"{threads}", "give 1 or more")
    if not 0 <= seed < 2**32:
        raise HeadError("--seed", f"{seed}", "give 0 to 4294967295")
    if remeshed < 0:
        raise HeadError("--remeshed", f"{remeshed}", "give 0 or more")
    config = training.TrainConfig(
        minutes=minutes,
        remeshed=remeshed,
        seed=seed,
        device=_device(device),
        threads=threads,
    )
    training.train(
        config,
        load_folder(labelled),
        out,
        unlabelled=load_folder(unlabelled) if unlabelled else (),
        validation=load_folder(validation) if validation else None,
        start=training.load_model(start) if start else None,
    )
    print(f"{out}: use it with `skinlib skin IN OUT --checkpoint {out}`")


def _device(name: str) -> str:
    import torch

    try:
        torch.zeros(1, device=name).item()
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise HeadError(
            "--device",
            f"{name!r} cannot be used here",
            "take cpu; see `skinlib check` for what torch finds",
        ) from error
    return name


def evaluate(
    *,
    heads: Folder,
    train_heads: OptionalFolder = None,
    checkpoint: Checkpoint = DEFAULT_CHECKPOINT,
    json_file: Annotated[Path | None, arg(name="json", metavar="FILE")] = None,
) -> None:
    """Compare our weights with what riggers use today, on heads that you have skinned.

    row-L1 is how much of a vertex's weight sits on wrong bones: 0 perfect, 2 all wrong.
    Heads that the network was trained on flatter it; judge by others.

    For example:
      skinlib evaluate --heads test_heads
      skinlib evaluate --heads test_heads --train-heads my_heads --json scores.json

    Args:
        heads: Folder of skinned heads to predict and to compare with.
        train_heads: Folder of skinned heads that the template methods may copy from.
        checkpoint: A shipped network, or a folder that `skinlib train` wrote.
        json_file: Also write every number there.
    """
    from skinlib.datasets.folder import load_folder
    from skinlib.evaluate import compare
    from skinlib.io import atomic
    from skinlib.training import load_model

    _check_json(json_file)
    scores = compare.evaluate(
        load_folder(heads),
        load_folder(train_heads) if train_heads else None,
        load_model(checkpoint),
    )
    print(compare.format_table(scores))
    if json_file:
        with atomic(json_file) as file:
            file.write(f"{json.dumps(scores, indent=1)}\n".encode())


def _check_json(path: Path | None) -> None:
    if path and not path.parent.is_dir():
        raise HeadError(
            "--json", "there is no such folder", "make it first", path.parent
        )


def bench(
    *,
    out: Folder,
    heads: OptionalFolder = None,
    unlabelled: OptionalFolder = None,
    others: OptionalFolder = None,
    folds: Annotated[tuple[int, ...], arg(metavar="N ...")] = (0, 1, 2),
    minutes: Annotated[float | None, arg(metavar="M")] = None,
    suites: Annotated[tuple[str, ...], arg(metavar="SUITE ...")] = (),
    methods: Annotated[tuple[str, ...], arg(metavar="METHOD ...")] = (),
) -> None:
    """HeadBench: every method on every suite of heads that it has not learnt from.

    Trains the networks that take part, on all topology groups but the held-out ones,
    then judges them beside the classical methods: untouched heads, remeshed, reordered,
    with pieces missing, rotated, posed, on changed skeletons. Writes a page with tables
    and figures, OUT/page/index.html. Can be stopped; the same command goes on.

    For example:
      skinlib bench --out runs/bench                        # small synthetic heads
      skinlib bench --heads my_heads --out runs/mine --minutes 30

    A network of your own takes part when its folder lies in OUT/networks/fold0.

    Args:
        out: Folder for networks, scores and the page; made when there is none.
        heads: Folder of skinned heads with several base meshes; synthetic ones when
            left out.
        unlabelled: Folder of heads without weights, for the semi-supervised network.
        others: Folder of skinned heads with other rigs, only to be judged by.
        folds: Which quarters of the topology groups are held out, in turn: 0 to 3.
        minutes: Processor time for each network to be trained; 8, or a quarter of one
            on synthetic heads.
        suites: Only these; all when left out.
        methods: Only these; all that work here when left out.
    """
    from skinlib.datasets.folder import load_folder
    from skinlib.datasets.synthetic import synthetic_heads
    from skinlib.headbench import bench as headbench
    from skinlib.headbench.networks import OURS
    from skinlib.headbench.targets import targets
    from skinlib.views.headbench import markdown, methods_table, write_page

    minutes = minutes if minutes is not None else 8.0 if heads else 0.25
    if not 0 < minutes < float("inf"):
        raise HeadError("--minutes", f"{minutes:g}", "give more than 0")
    contest = headbench.Bench(
        heads=load_folder(heads) if heads else synthetic_heads(8, 0, vertices=800),
        unlabelled=load_folder(unlabelled) if unlabelled else (),
        others=load_folder(others) if others else (),
        folds=folds,
        minutes=minutes,
        suites=suites or headbench.ALL_SUITES,
        methods=methods,
    )
    results = headbench.run(contest, out)
    page = write_page(results, targets(results, OURS), out / "page")
    print(markdown(methods_table(results)))
    print(f"{page}: tables and figures")


def garment_simulate(
    mesh: Annotated[Positional[Path], arg(metavar="MESH")],
    *,
    out: Folder,
    body: Annotated[Path | None, arg(metavar="FILE")] = None,
    motions: Annotated[int, arg(metavar="N")] = 56,
    poses: Annotated[tuple[Path, ...], arg(metavar="FILE ...")] = (),
    pin_top: bool = False,
    pin_above: Annotated[float | None, arg(metavar="Z")] = None,
    seed: Annotated[int, arg(metavar="S")] = 0,
    device: Annotated[str, arg(metavar="D")] = "cpu",
    workers: Annotated[int, arg(metavar="P")] = 1,
) -> None:
    """Let a loose garment, such as a skirt, swing on a walking body, to learn from it.

    MESH is a garment at rest on the body, as for `skinlib garment train`. Ctrl-C stops;
    the same command goes on where it stopped, and may ask for more motions.

    For example:
      skinlib garment simulate data_samples/skirt.npz --out runs/swinging
      skinlib garment train data_samples/skirt.npz --simulated runs/swinging \\
        --out runs/skirt

    Args:
        mesh: The garment.
        out: Folder for the simulations, one file for each motion.
        body: Skinned body (.npz, see data_samples/README.md); else the shipped one.
        motions: How many are drawn at random; three in four are walks.
        poses: Simulate these motion files (.npz) instead.
        pin_top: Hold the garment at its highest opening, as a skirt at the waist.
        pin_above: Hold it at all vertices higher than Z metres.
        seed: Same seed, same motions; another one for what is not to be learnt.
        device: Where to compute, such as cpu or cuda.
        workers: Processes.
    """
    from skinlib.garments.body import read_body
    from skinlib.garments.loose import simulation_motions
    from skinlib.garments.motion import read_motion
    from skinlib.garments.outfit import Outfit
    from skinlib.garments.simulation import simulate_motions

    _check_numbers(("--motions", motions, 1), ("--workers", workers, 1))
    _check_seed(seed)
    device = _device(device)
    outfit = Outfit.create(read_body(body), _garments([mesh], pin_top, pin_above))
    head = outfit.body.head
    chosen = [read_motion(path) for path in poses]
    if not chosen:
        chosen = simulation_motions(head.skeleton, seed, motions)
    (garment,) = outfit.garments
    if device.startswith("cuda") and ":" not in device:
        device += ":0"  # Warp wants to know which one
    simulate_motions(garment, head, chosen, out, workers=workers, device=device)
    print(f"{out}: learn it with `skinlib garment train {mesh} --simulated {out}`")


def garment_train(
    meshes: Annotated[Positional[tuple[Path, ...]], arg(metavar="MESH ...")],
    *,
    out: Folder,
    body: Annotated[Path | None, arg(metavar="FILE")] = None,
    poses: Annotated[Path | None, arg(metavar="FILE")] = None,
    simulated: OptionalFolder = None,
    bones: Annotated[int, arg(metavar="N")] = 24,
    pin_top: bool = False,
    pin_above: Annotated[float | None, arg(metavar="Z")] = None,
    shapes: bool = False,
    smooth: Annotated[int | None, arg(metavar="N")] = None,
    steps: Annotated[int | None, arg(metavar="N")] = None,
    seed: Annotated[int, arg(metavar="S")] = 0,
    device: Annotated[str, arg(metavar="D")] = "cpu",
    threads: Annotated[int, arg(metavar="T")] = min(2, os.cpu_count() or 1),
) -> None:
    """Learn how a garment moves with a body.

    From physics alone, for what lies on the body; or, with --simulated, from a
    simulation, for what swings, such as a skirt: on virtual bones, with a memory.

    MESH is a garment at rest on the body: .glb, .gltf, .obj, .ply, .stl or .npz, in
    metres. Name several from the skin outwards, and they learn to stay apart. Ctrl-C
    stops; the same command goes on where it stopped.

    For example:
      skinlib garment train data_samples/t_shirt.npz --out runs/t_shirt
      skinlib garment train kilt.glb --out runs/kilt --pin-top --smooth 50
      skinlib garment train shirt.obj coat.obj --out runs/coat --body me.npz
      skinlib garment train kilt.glb --out runs/kilt --simulated runs/swinging
      skinlib garment play runs/t_shirt --poses walk --out walk.glb

    Args:
        meshes: The garments.
        out: Folder that all is written to; made when there is none.
        body: Skinned body (.npz, see data_samples/README.md); else the shipped one.
        poses: Motion (.npz) with the poses to learn; else 8,000 random ones, mirrored.
        simulated: What `skinlib garment simulate` wrote of this garment.
        bones: How many virtual bones then move it.
        pin_top: Hold the garment at its highest opening, as a skirt at the waist.
        pin_above: Hold it at all vertices higher than Z metres.
        shapes: Learn the shapes of the body and looser cuts, too.
        smooth: Rounds of smoothing of the skin weights; 10, or 50 for what is pinned.
        steps: How long to train: 10,000 steps unless simulated, which are ten to
            fifteen minutes; then 1,600, a minute or two.
        seed: Same seed, same garment.
        device: Where to compute, such as cpu or cuda.
        threads: CPU cores to use.
    """
    from skinlib.garments.body import read_body
    from skinlib.garments.motion import read_motion
    from skinlib.garments.outfit import Outfit
    from skinlib.garments.training import GarmentConfig
    from skinlib.garments.training import train as train_garment

    _check_numbers(
        ("--steps", 1 if steps is None else steps, 1),
        ("--threads", threads, 1),
        ("--smooth", smooth or 0, 0),
        ("--bones", bones, 1),
    )
    _check_seed(seed)
    garments = _garments(meshes, pin_top, pin_above)
    outfit = Outfit.create(read_body(body), garments)
    if simulated:
        for name, given in (
            ("--poses", poses),
            ("--shapes", shapes),
            ("--smooth", smooth),
        ):
            if given:
                raise HeadError(name, "given with --simulated", "leave one of them out")
        same = {"seed": seed, "device": _device(device), "threads": threads}
        _train_loose(outfit, simulated, out, bones=bones, steps=steps, **same)
        return
    hangs = bool(outfit.pinned.any())
    if smooth is None:
        smooth = 50 if hangs else 10
    config = GarmentConfig(
        steps=10_000 if steps is None else steps,
        smoothing=smooth,
        touch=0.0 if hangs else GarmentConfig.touch,
        shapes=shapes,
        seed=seed,
        device=_device(device),
        threads=threads,
    )
    train_garment(config, outfit, out, read_motion(poses) if poses else None)
    print(
        f"{out}: play it with `skinlib garment play {out} --poses walk --out OUT.glb`"
    )


def _train_loose(outfit, simulated: Path, out: Path, steps: int | None, **settings):
    """Train a garment on virtual bones."""
    from skinlib.garments.loose import LooseConfig, read_simulations, train
    from skinlib.garments.simulation import check_simulated

    if len(outfit.garments) > 1:
        raise HeadError("MESH", "several garments", "simulate and train one at a time")
    if steps is not None:
        settings["steps"] = steps
    config, (garment,) = LooseConfig(**settings), outfit.garments
    learnt = read_simulations(simulated)
    check_simulated(simulated, garment, outfit.body.head)
    train(config, outfit.body, garment, learnt, out)
    print(
        f"{out}: play it with `skinlib garment play {out} --poses walk --out OUT.glb`"
    )


def _garments(meshes: Sequence[Path], pin_top: bool, pin_above: float | None) -> list:
    """The meshes, pinned as asked for."""
    from skinlib.garments.garment import pin_boundary, read_garment

    garments = [read_garment(mesh) for mesh in meshes]
    if pin_top or pin_above is not None:
        garments = [pin_boundary(garment, pin_above) for garment in garments]
    return garments


def _check_numbers(*options: tuple[str, int, int]) -> None:
    """Refuse what is below the least that makes sense."""
    for name, value, least in options:
        if value < least:
            raise HeadError(name, f"{value}", f"give {least} or more")


def _check_seed(seed: int) -> None:
    _check_numbers(("--seed", seed, 0))
    if seed >= 2**32:
        raise HeadError("--seed", f"{seed}", "give 0 to 4294967295")


def garment_play(
    folder: Annotated[Positional[Path], arg(metavar="DIR")],
    *,
    poses: Annotated[str, arg(metavar="FILE|NAME")] = "walk",
    out: Annotated[Path, arg(metavar="FILE")],
    shape: Annotated[dict[str, float], arg(metavar="NAME AMOUNT ...")] = {},  # noqa: B006
    ease: Annotated[float, arg(metavar="E")] = 0.0,
) -> None:
    """Write a trained garment in motion, for Blender, an engine or numpy.

    For example:
      skinlib garment play t_shirt --poses walk --shape weight 0.5 --out walk.glb
      skinlib garment play runs/t_shirt --poses my_motion.npz --out vertices.npz

    Args:
        folder: What `skinlib garment train` wrote, or a shipped one, such as t_shirt.
        poses: Motion file (.npz), or walk, turn, squat or reach.
        out: A .glb has the body, the bones and the garments, with the blend shapes, or
            the virtual bones, driven frame by frame; a .npz has the vertices of every
            frame.
        shape: Of the body, such as `weight 0.5`, for a garment trained with --shapes.
        ease: By how much the cloth is cut wider, such as 0.05, for one trained so.
    """
    from skinlib.animation import write_vertex_cache
    from skinlib.garments.loose import is_loose, load_loose
    from skinlib.garments.motion import MOTIONS, read_motion
    from skinlib.garments.outfit import load_outfit

    if out.suffix.lower() not in {".glb", ".npz"}:
        raise HeadError("--out", f"{out.suffix!r}", "name a .glb or a .npz file", out)
    is_file = Path(poses).is_file()
    if not is_file and poses not in MOTIONS:
        raise HeadError(
            "--poses",
            f"there is no file and no motion {poses!r}",
            f"name a .npz file, or one of {', '.join(MOTIONS)}",
        )
    if is_loose(folder):
        if shape or ease:
            raise HeadError(
                "--shape" if shape else "--ease",
                "this garment was simulated on one body",
                "leave it out",
            )
        loose = load_loose(folder)
        body, faces = loose.body, loose.garment.faces
        pose, export = loose.pose, loose.export
    else:
        outfit, network = load_outfit(folder)
        body, faces = outfit.body, outfit.faces

        def pose(motion):
            return outfit.pose(network, motion, shape, ease)

        def export(path, motion):
            outfit.export(path, network, motion, shape, ease)

    skeleton = body.head.skeleton
    motion = read_motion(poses) if is_file else MOTIONS[poses](skeleton)
    if out.suffix.lower() == ".npz":
        write_vertex_cache(out, pose(motion), faces, motion.fps)
    else:
        export(out, motion)
    print(f"{out}: {len(motion)} frames at {motion.fps:g} a second")


def garment_evaluate(
    folder: Annotated[Positional[Path], arg(metavar="DIR")],
    *,
    poses: Annotated[Path | None, arg(metavar="FILE")] = None,
    simulated: OptionalFolder = None,
    json_file: Annotated[Path | None, arg(name="json", metavar="FILE")] = None,
) -> None:
    """Judge a trained garment beside skinning alone, on poses it has not learnt.

    Args:
        folder: What `skinlib garment train` wrote, or a shipped one, such as t_shirt.
        poses: Motion file (.npz); else eight motions that no training draws.
        simulated: For one on virtual bones, the distance to these simulations, too, in
            mm; of another seed than those it has learnt.
        json_file: Write the numbers to this file, too.
    """
    from dataclasses import asdict

    from skinlib.garments.loose import KIND, errors, is_loose, load_loose
    from skinlib.garments.loose import read_simulations as read_all
    from skinlib.garments.measures import joined, measure, skinned
    from skinlib.garments.motion import held_out_motions, read_motion
    from skinlib.garments.outfit import Outfit, load_outfit
    from skinlib.io import atomic

    _check_json(json_file)
    loose, network = None, None
    if is_loose(folder):
        loose = load_loose(folder)
        outfit = Outfit(loose.body, (loose.garment,))
    else:
        outfit, network = load_outfit(folder)
    if simulated and not loose:
        raise HeadError(
            "--simulated", "this garment is not on virtual bones", "leave it out"
        )
    distances = errors(loose, read_all(simulated)) if loose and simulated else {}
    skeleton = outfit.body.head.skeleton
    motion = read_motion(poses) if poses else joined(held_out_motions(skeleton))
    if loose:
        alone = loose.baselines(motion)["skinning alone"]
        posed = {"skinning alone": alone, KIND: loose.pose(motion)}
    else:
        alone = skinned(outfit, motion)
        posed = {"skinning alone": alone, "PBNS": outfit.pose(network, motion)}
    results = {name: measure(outfit, motion, found) for name, found in posed.items()}
    for name, result in results.items():
        print(f"{name}: {result.line()}")
    for name, distance in distances.items():
        print(f"{name}: {distance:.1f} mm from the simulation")
    if json_file:
        numbers = {name: asdict(result) for name, result in results.items()}
        if distances:
            numbers["mm from the simulation"] = distances
        with atomic(json_file) as file:
            file.write(f"{json.dumps(numbers, indent=1)}\n".encode())


def pose_train(
    *,
    out: Folder,
    people: Annotated[str, arg(metavar="shipped|anny|DIR")] = "shipped",
    vertices: Annotated[tuple[int, ...], arg(metavar="N ...")] = (1229,),
    identities: Annotated[int, arg(metavar="I")] = 16,
    poses: Annotated[int, arg(metavar="T")] = 400,
    wide: bool = False,
    network: Annotated[str, arg(metavar="NAME")] = "dsffnet",
    width: Annotated[int, arg(metavar="C")] = 1024,
    steps: Annotated[int, arg(metavar="N")] = 51_200,
    rate: Annotated[float, arg(metavar="R")] = 2e-3,
    noise: Annotated[float, arg(metavar="A")] = 0.0,
    mirrored: bool = False,
    by_vertex: bool = False,
    seed: Annotated[int, arg(metavar="S")] = 0,
    device: Annotated[str, arg(metavar="D")] = "cpu",
    threads: Annotated[int, arg(metavar="T")] = min(2, os.cpu_count() or 1),
) -> None:
    """Learn to give one mesh the pose of another, without any bones.

    Who takes part is drawn from the seed: people in random poses, who share neither the
    order nor the number of their vertices. Ctrl-C stops; the same command goes on where
    it stopped. At full width it takes a GPU, or days.

    For example:
      skinlib pose train --out runs/pose --device cuda
      skinlib pose train --out runs/small --width 256 --vertices 369 --steps 4000
      skinlib pose train --out runs/faces --people cast --vertices --by-vertex

    Args:
        out: Folder that all is written to; made when there is none.
        people: The shipped body in random shapes, Anny's bodies, or a folder of skinned
            heads or bodies that share a mesh and bones.
        vertices: Of each mesh that they are given; without a number, the one they have.
        identities: People to learn; of a folder three quarters are learnt.
        poses: How many each of them takes.
        wide: Bend as far as joints can, not only as far as in the source's data.
        network: dsffnet, npt or corenet.
        width: Of the network; 256 has a fifteenth of the parameters.
        steps: How long to train, 8 pairs a step.
        rate: The highest learning rate.
        noise: On the sources, as a share of their size, such as 0.01.
        mirrored: Learn all of them in a mirror, too.
        by_vertex: Means over vertices, not over the surface: for meshes that are all
            alike, with the detail where they are dense, as heads are.
        seed: Same seed, same network.
        device: Where to compute, such as cpu or cuda.
        threads: CPU cores to use.
    """
    from skinlib.pose_transfer.population import Population
    from skinlib.pose_transfer.training import TransferConfig, train

    _check_numbers(("--steps", steps, 1), ("--threads", threads, 1))
    _check_seed(seed)
    if not 0 < rate < float("inf"):
        raise HeadError("--rate", f"{rate}", "give more than 0, such as 0.001")
    limits = "wide" if wide else "npt"
    population = Population(
        people, vertices, identities, poses=poses, limits=limits, seed=seed
    )
    settings = {"width": width}
    if network != "corenet":  # the only one without this encoder
        settings["encoder"] = max(width // 16, 32)
    if by_vertex and network != "corenet":  # it has no other means
        settings["by_area"] = False
    config = TransferConfig(
        network=network,
        settings=settings,
        steps=steps,
        learning_rate=rate,
        noise=noise,
        mirrored=mirrored,
        seed=seed,
        device=_device(device),
        threads=threads,
    )
    casts = population.casts("train", config.device)
    train(config, casts, out, {"population": population.describe()})
    print(f"{out}: use it with `skinlib pose transfer SOURCE TARGET OUT --model {out}`")


def pose_transfer(
    source: Annotated[Positional[Path], arg(metavar="SOURCE")],
    target: Annotated[Positional[Path], arg(metavar="TARGET")],
    out: Annotated[Positional[Path], arg(metavar="OUT")],
    *,
    model: Checkpoint = "poses",
    reach: Annotated[float, arg(metavar="R")] = 0.07,
) -> None:
    """Give the mesh TARGET the pose of the mesh SOURCE.

    Neither needs bones or weights, and they need not share a mesh. Both are bodies,
    unless --model has learnt something else; they stand upright and face -Y, as people
    do in Blender. OUT has the triangles, texture coordinates and size of TARGET.

    For example:
      skinlib pose transfer dancer.glb me.obj me_dancing.obj
      skinlib pose transfer smile.glb other.glb smiling.glb --model runs/faces

    Args:
        source: Mesh whose pose is taken: .glb, .gltf, .obj, .ply or .stl.
        target: Mesh that takes it.
        out: Where the posed mesh goes: .glb, .obj, .ply or .stl.
        model: A shipped network, or a folder that `skinlib pose train` wrote.
        reach: How far the shape of TARGET is kept, as a share of its size; 0 for what
            the network gives, which is softer.
    """
    from skinlib.pose_transfer.training import load_network
    from skinlib.pose_transfer.transfer import check_mesh_target, transfer_file

    check_mesh_target(out)
    if not 0 <= reach < float("inf"):
        raise HeadError("--reach", f"{reach}", "give 0 or more, such as 0.07")
    transfer_file(load_network(model)[0], source, target, out, reach)
    print(f"{out}: {target.name} in the pose of {source.name}")


def pose_evaluate(
    folder: Annotated[Positional[str], arg(metavar="DIR")],
    *,
    pairs: Annotated[int, arg(metavar="N")] = 200,
    json_file: Annotated[Path | None, arg(name="json", metavar="FILE")] = None,
) -> None:
    """Judge a trained pose transfer on people whom it has never seen.

    In poses that it has learnt with others, and in poses that it has not, beside a copy
    of the target as it stands.

    Args:
        folder: What `skinlib pose train` wrote, or a shipped network.
        pairs: How many of each to judge by.
        json_file: Write the numbers to this file, too.
    """
    from dataclasses import asdict

    from skinlib.io import atomic
    from skinlib.pose_transfer.population import Population, judging
    from skinlib.pose_transfer.training import load_network
    from skinlib.pose_transfer.transfer import judge

    _check_json(json_file)
    _check_numbers(("--pairs", pairs, 1))
    network, told = load_network(folder)
    population = Population.read(told, folder)
    seen, unseen = judging(population, pairs)
    results = {
        "poses it has learnt": judge(network, seen),
        "poses it has not": judge(network, unseen),
        "the same, target copied": judge(None, unseen),
    }
    for name, result in results.items():
        print(f"{name}: {result.line()}")
    if json_file:
        numbers = {name: asdict(result) for name, result in results.items()}
        with atomic(json_file) as file:
            file.write(f"{json.dumps(numbers, indent=1)}\n".encode())


def demo(*, out: Folder = Path("demo")) -> None:
    """Skin the sample head, print the scores, write a .glb and a picture.

    Args:
        out: Folder that the files are written to.
    """
    from skinlib.demo import run_demo

    run_demo(out)


def lab(*, port: Annotated[int, arg(metavar="P")] = 8866, browser: bool = True) -> None:
    """Open the loss lab: learn a small head while you turn the weights of its loss.

    A page for your browser, served by this machine for this machine; Ctrl-C ends it.
    Notebook 10 says what to try.

    Args:
        port: Where the page is served; the next free one when it is taken.
        browser: Open the page; else only say its address.
    """
    if not 0 < port < 65536:
        raise HeadError("--port", f"{port}", "give 1 to 65535")
    from skinlib.views.lab import serve

    serve(port, browser)


def check() -> None:
    """Say what works on this machine; a bug report wants to see it."""
    from skinlib.check import run_checks

    findings = run_checks()
    print("\n".join(map(str, findings)))
    if any(finding.status == "FAIL" for finding in findings):
        sys.exit(1)


def garment() -> None:
    """Learn how clothes move with a body: simulate, train, play, evaluate."""


def pose() -> None:
    """Give one mesh the pose of another, without bones: train, transfer, evaluate."""


COMMANDS = {
    "skin": skin,
    "train": train,
    "evaluate": evaluate,
    "bench": bench,
    "garment": garment,
    "pose": pose,
    "lab": lab,
    "demo": demo,
    "check": check,
}

GROUPS = {
    "garment": {
        "simulate": garment_simulate,
        "train": garment_train,
        "play": garment_play,
        "evaluate": garment_evaluate,
    },
    "pose": {
        "train": pose_train,
        "transfer": pose_transfer,
        "evaluate": pose_evaluate,
    },
}


def main(args: Sequence[str] | None = None) -> None:
    """Run a command; bad input ends in one line on stderr and exit status 2."""
    # The cores are shared with whatever else runs; threads that spin would take them.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # A progress bar that goes to a file: a line every ten seconds is enough.
    if not sys.stderr.isatty():
        os.environ.setdefault("TQDM_MININTERVAL", "10")
    # A file name need not be text that the terminal can show.
    sys.stdout.reconfigure(errors="backslashreplace")
    # `kill` and `timeout` stop a command as Ctrl-C does.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    args = list(sys.argv[1:] if args is None else args)
    commands, prog, about = COMMANDS, "skinlib", "Head in, skinned head out."
    if args and args[0] in GROUPS:
        prog += f" {args[0]}"
        about = COMMANDS[args[0]].__doc__
        commands = GROUPS[args.pop(0)]
    try:
        tyro.extras.subcommand_cli_from_dict(
            commands,
            prog=prog,
            description=about,
            args=args,
            config=(FlagCreatePairsOff,),
        )
    except (HeadError, OSError, FloatingPointError) as error:
        if isinstance(error, OSError) and error.filename:
            error = f"{error.filename}: {error.strerror}"
        print(f"skinlib: {error}", file=sys.stderr)
        sys.exit(BAD_INPUT)
    except MemoryError:
        print("skinlib: there is not enough memory for this head", file=sys.stderr)
        sys.exit(BAD_INPUT)
    except KeyboardInterrupt:
        print("skinlib: stopped", file=sys.stderr)
        sys.exit(INTERRUPTED)
