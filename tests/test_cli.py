import errno
import inspect
import json
import os
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pygltflib
import pytest
import trimesh
from test_body import bends, sleeve, small_body
from test_outfit import band
from test_virtual_bones import smoothly

from skinlib import check, cli, demo, gltf
from skinlib.datasets.synthetic import synthetic_heads
from skinlib.garments import training as garment_training
from skinlib.garments.body import read_body, write_body
from skinlib.garments.garment import write_garment
from skinlib.garments.loose import load_loose, read_simulations
from skinlib.garments.motion import Motion, write_motion
from skinlib.garments.outfit import load_outfit
from skinlib.io import read_head, write_head
from skinlib.model import ModelConfig, SkinningModel
from skinlib.painting import limit_influences, prune, smooth_weights, symmetrize
from skinlib.paths import sample
from skinlib.pose_transfer.data import drawn_bodies
from skinlib.pose_transfer.training import make_network, save_network
from skinlib.training import TrainConfig, load_model, save_model

SMALL = ModelConfig(mesh_width=8, bone_width=8, blocks=1, points=2, tree_layers=1)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with three skinned heads, one unskinned, and a small network."""
    folder = tmp_path_factory.mktemp("cli")
    (folder / "heads").mkdir()
    heads = synthetic_heads(3, seed=5, vertices=600)
    for i, head in enumerate(heads):
        write_head(folder / "heads" / f"head_{i}.npz", head)
    write_head(folder / "skinned.glb", heads[0])
    write_head(folder / "bare.npz", heads[0].replace(weights=None))
    (folder / "bare").mkdir()
    (folder / "alone").mkdir()
    write_head(folder / "bare" / "head.npz", heads[0].replace(weights=None))
    marks = {"attributes": {"_LOCKED": np.ones(len(heads[0].vertices))}}
    write_head(folder / "full.npz", heads[0], **marks)
    write_head(folder / "marked.npz", heads[0].replace(weights=None), **marks)
    save_model(SkinningModel(SMALL), folder / "network", {})
    return folder


@pytest.fixture
def run(place, monkeypatch):
    """Run a command in `place`; returns its exit status."""
    monkeypatch.chdir(place)

    def run(*args) -> int:
        try:
            cli.main([str(arg) for arg in args])
        except SystemExit as end:
            return end.code
        return 0

    return run


def skin(run, *args) -> np.ndarray:
    assert run("skin", *args, "--checkpoint", "network") == 0
    return read_head(args[1]).weights


# ------------------------------------------------------------------------------- help


@pytest.mark.parametrize(
    "command, words",
    [
        ("skin", "IN OUT --checkpoint --painted --max-influences --lock --symmetric"),
        ("skin", "--lock-vertices ATTRIBUTE _LOCKED --smooth --confidence"),
        ("bench", "--heads --out --unlabelled --others --folds --minutes --suites"),
        ("train", "--labelled --unlabelled --out --minutes --seed --device --start"),
        ("train", "--remeshed --validation --threads"),
        ("evaluate", "--heads --train-heads --checkpoint --json row-L1"),
        ("garment train", "MESH --out --body --poses --pin-top --pin-above --shapes"),
        ("garment train", "--smooth --steps --seed --device --threads Ctrl-C metres"),
        ("garment simulate", "MESH --out --body --motions --poses --pin-top --device"),
        ("garment simulate", "--pin-above --seed --workers Ctrl-C"),
        ("garment train", "--simulated DIR --bones N"),
        ("garment play", "DIR --poses FILE|NAME --out --shape --ease .glb .npz"),
        ("garment evaluate", "DIR --poses --simulated --json"),
        ("pose train", "--out --people --vertices --identities --poses --network"),
        ("pose train", "--wide --mirrored --by-vertex --width --steps --rate --noise"),
        ("pose train", "--seed --device --threads Ctrl-C"),
        ("pose transfer", "SOURCE TARGET OUT --model --reach .glb .obj"),
        ("pose evaluate", "DIR --pairs --json"),
        ("lab", "--port --no-browser Ctrl-C"),
        ("demo", "--out"),
        ("check", "bug report"),
    ],
)
def test_help_names_every_option(run, capsys, command, words):
    assert run(*command.split(), "--help") == 0
    text = capsys.readouterr().out
    assert [word for word in words.split() if word not in text] == []


def test_help_waits_for_no_slow_import():
    code = (
        "import sys; from skinlib import cli\n"
        "try: cli.main(['skin', '--help'])\n"
        "finally: print([m for m in ('torch', 'igl', 'vtk') if m in sys.modules])"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True
    )
    assert result.stdout.splitlines()[-1] == "[]"


def test_the_defaults_are_those_of_the_library():
    options = inspect.signature(cli.train).parameters
    for name in ("minutes", "seed", "device", "threads"):
        assert options[name].default == getattr(TrainConfig(), name)


def test_python_m_skinlib_is_the_command(place):
    command = [sys.executable, "-m", "skinlib", "skin", "no.glb", "out.glb"]
    result = subprocess.run(command, capture_output=True, text=True, cwd=place)
    assert result.returncode == 2
    assert result.stderr.startswith("skinlib: no.glb: ")
    assert result.stderr.count("\n") == 1


# ------------------------------------------------------------------------------- skin


@pytest.mark.parametrize("source", ["bare.npz", "skinned.glb"])
@pytest.mark.parametrize("target", ["out.npz", "out.glb"])
def test_skin_writes_what_the_network_predicts(run, source, target):
    weights = skin(run, source, target)
    expected = load_model("network").predict(read_head(source))
    np.testing.assert_allclose(weights, expected, atol=1e-6)


@pytest.mark.parametrize("suffix", ["npz", "glb"])
def test_half_painted_head_is_skinned(run, place, capsys, suffix):
    head = read_head(place / "heads" / "head_0.npz")
    if suffix == "npz":
        arrays = dict(np.load(place / "heads" / "head_0.npz"))
        arrays["weights"][0] = 0
        np.savez(place / "half.npz", **arrays)
    else:
        write_head(place / "half.glb", head)
        document = pygltflib.GLTF2().load(place / "half.glb")
        primitive = document.meshes[0].primitives[0]
        accessor = document.accessors[primitive.attributes.WEIGHTS_0]
        view = document.bufferViews[accessor.bufferView]
        start = (view.byteOffset or 0) + (accessor.byteOffset or 0)
        blob = bytearray(document.binary_blob())
        blob[start : start + 16] = bytes(16)
        document.set_binary_blob(bytes(blob))
        document.save(place / "half.glb")
    weights = skin(run, f"half.{suffix}", f"whole.{suffix}")
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-6)
    # Locked bones are read from the file, which then has to be painted.
    command = ("skin", f"half.{suffix}", "x.npz", "--checkpoint", "network")
    assert run(*command, "--lock", head.skeleton.names[0]) == 2
    assert "vertex 0 sums to 0" in capsys.readouterr().err


def test_max_influences(run):
    weights = skin(run, "bare.npz", "out.npz", "--max-influences", 2)
    assert (weights > 0).sum(axis=1).max() == 2
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-6)


def test_symmetric(run):
    head = read_head("bare.npz")
    predicted = load_model("network").predict(head)
    weights = skin(run, "bare.npz", "out.npz", "--symmetric")
    np.testing.assert_allclose(weights, symmetrize(head, predicted), atol=1e-6)


def test_painted_heads_lend_their_weights(run, capsys):
    # The first of the three painted heads is the bare one.
    weights = skin(run, "bare.npz", "out.npz", "--painted", "heads")
    expected = read_head("heads/head_0.npz").weights
    same = np.abs(weights - expected).sum(axis=1) < 1e-5
    assert same.mean() > 0.9
    assert "of the vertices are as in heads" in capsys.readouterr().out
    write_head("alone/head_2.npz", read_head("heads/head_2.npz"))
    weights = skin(run, "bare.npz", "out.npz", "--painted", "alone")
    predicted = load_model("network").predict(read_head("bare.npz"))
    np.testing.assert_allclose(weights, predicted, atol=1e-6)
    assert "\n0% of the vertices are as in alone" in capsys.readouterr().out


def test_locked_bones_keep_their_weights(run):
    head = read_head("heads/head_0.npz")
    names = [head.skeleton.names[bone] for bone in (0, 2)]
    weights = skin(run, "heads/head_0.npz", "out.npz", "--lock", *names)
    assert np.array_equal(weights[:, [0, 2]], head.weights[:, [0, 2]])
    assert not np.array_equal(weights, head.weights)


@pytest.mark.parametrize("suffix", ["npz", "glb"])
def test_locks_are_kept_to_the_bit_whatever_else_is_asked(run, place, suffix):
    head = read_head(place / "heads" / "head_0.npz")
    head = head.replace(weights=limit_influences(head.weights, 3))
    rng = np.random.default_rng(0)
    locked = rng.random(len(head.vertices)) < 0.2
    extras = {"attributes": {"_LOCKED": locked, "_OTHER": ~locked}}
    write_head(place / f"painted.{suffix}", head, **extras)
    painted = read_head(place / f"painted.{suffix}").weights
    weights = skin(
        *(run, f"painted.{suffix}", f"kept.{suffix}", "--lock", "jaw"),
        *("--lock-vertices", "_LOCKED", "--symmetric", "--max-influences", 4),
        *("--smooth", 2),
    )
    jaw = head.skeleton.names.index("jaw")
    assert np.array_equal(weights[locked], painted[locked])
    assert np.array_equal(weights[:, jaw], painted[:, jaw])
    assert not np.array_equal(weights, painted)
    assert (weights > 0).sum(axis=1).max() <= 4
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=2e-6)
    # The marks are still in a .glb, as all else that we did not make.
    if suffix == "glb":
        again = skin(run, "kept.glb", "again.glb", "--lock-vertices", "_OTHER")
        assert np.array_equal(again[~locked], weights[~locked])


def test_smooth(run):
    plain = skin(run, "bare.npz", "out.npz")
    smooth = skin(run, "bare.npz", "out.npz", "--smooth", 3)
    head = read_head("bare.npz")
    expected = prune(smooth_weights(head, plain, 3), 0.01)
    np.testing.assert_allclose(smooth, expected, atol=1e-6)


def test_confidence_is_painted_and_goes_when_it_is_no_longer_true(run, place, capsys):
    plain = skin(run, "skinned.glb", "plain.glb")
    sure = skin(run, "skinned.glb", "sure.glb", "--confidence")
    np.testing.assert_allclose(sure, plain, atol=1e-5)
    assert "of the vertices are rather wrong than not" in capsys.readouterr().out
    file = pygltflib.GLTF2().load("sure.glb")
    attributes = vars(file.meshes[0].primitives[0].attributes)
    values = gltf.read_attribute(place / "sure.glb", "_CONFIDENCE")
    # The colour is white as far as the number says.
    red, green, blue, _ = colour_bytes(file, attributes["COLOR_0"]).T
    np.testing.assert_allclose(green, 255 * values, atol=0.51)
    assert (red == 255).all() and (green == blue).all()
    assert 0 <= values.min() < values.max() <= 1
    # New weights without a new confidence.
    skin(run, "sure.glb", "again.glb")
    primitive = pygltflib.GLTF2().load("again.glb").meshes[0].primitives[0]
    assert primitive.attributes.COLOR_0 is None
    assert "_CONFIDENCE" not in vars(primitive.attributes)


def colour_bytes(file: pygltflib.GLTF2, accessor: int) -> np.ndarray:
    accessor = file.accessors[accessor]
    view = file.bufferViews[accessor.bufferView]
    start = (view.byteOffset or 0) + (accessor.byteOffset or 0)
    data = np.frombuffer(file.binary_blob(), "u1", 4 * accessor.count, start)
    return data.reshape(-1, 4)


def test_an_artist_s_own_vertices_are_sure(run):
    command = ("full.npz", "out.npz", "--confidence", "--lock-vertices", "_LOCKED")
    skin(run, *command)
    assert (np.load("out.npz")["confidence"] == 1).all()


# ---------------------------------------------------------------------- train, evaluate


def test_train_then_skin_with_it(run, place):
    command = ("train", "--labelled", "heads", "--out", "new", "--threads", 1)
    assert run(*command, "--start", "network", "--minutes", 0.005) == 0
    assert run("skin", "bare.npz", "out.npz", "--checkpoint", "new") == 0
    assert load_model("new").config == SMALL


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_stops_and_the_state_is_kept(place, number):
    out = f"stopped_{number}"
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from skinlib import cli\n"
        f"cli.main('train --labelled heads --out {out} --start network'.split())"
    )
    training = subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=place,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"TQDM_MININTERVAL": "0.1"},
    )
    begun = ""
    while "step=" not in begun:  # the progress bar shows the first steps
        read = training.stderr.read(1)
        assert read, begun
        begun += read
    training.send_signal(number)
    _, stderr = training.communicate(timeout=60)
    assert training.returncode == 130
    assert "Traceback" not in stderr
    assert stderr.endswith("skinlib: stopped\n")
    assert (place / out / "training.safetensors").is_file()


def test_evaluate_writes_the_table_and_the_numbers(run, capsys):
    status = run(
        *("evaluate", "--heads", "heads", "--train-heads", "heads"),
        *("--checkpoint", "network", "--json", "scores.json"),
    )
    assert status == 0
    table = capsys.readouterr().out
    with open("scores.json") as file:
        methods = json.load(file)["methods"]
    assert {"skinlib", "nearest_bone", "bone_heat", "template_copy"} <= methods.keys()
    expected = {"row_l1_mean", "row_l1_p95", "row_l1_max", "precision", "recall"}
    expected |= {"dominant_bone_accuracy", "seconds"}
    for name, scores in methods.items():
        assert name in table
        assert scores["heads"].keys() == {"head_0", "head_1", "head_2"}
        for row in [scores["mean"], *scores["heads"].values()]:
            assert expected <= row.keys()


# --------------------------------------------------------------------------------- pose

POSE = "pose train --people posts --vertices --poses 4 --width 32 --threads 1"


@pytest.fixture(scope="module")
def posts(place):
    """A folder of four bodies on one mesh in `place`, and two meshes to pose."""
    (place / "posts").mkdir()
    for number, head in enumerate(drawn_bodies(small_body(), 4)):
        write_head(place / "posts" / f"{number}.npz", head)
    ball = trimesh.creation.icosphere(2)
    ball.export(place / "ball.obj")
    ball.apply_scale([1, 2, 3])
    ball.export(place / "egg.ply")
    return place


def test_train_a_pose_transfer_judge_it_and_use_it(run, posts, capsys):
    assert run(*POSE.split(), "--steps", "3", "--out", "posed") == 0
    assert "skinlib pose transfer SOURCE TARGET OUT" in capsys.readouterr().out
    assert run(*"pose evaluate posed --pairs 3 --json posed.json".split()) == 0
    told = capsys.readouterr().out
    assert told.count("PMD") == 3 and "poses it has not" in told
    numbers = json.loads((posts / "posed.json").read_text())
    assert 0 < numbers["the same, target copied"]["pmd"] < 1
    command = "pose transfer egg.ply ball.obj new.glb --model posed"
    assert run(*command.split()) == 0
    new = trimesh.load_mesh(posts / "new.glb", process=False)
    ball = trimesh.load_mesh(posts / "ball.obj", process=False)
    np.testing.assert_array_equal(new.faces, ball.faces)


def test_options_of_pose_train_reach_the_training(run, posts):
    options = "--network npt --rate 0.01 --noise 0.02 --seed 3 --identities 2 --wide"
    options = [*options.split(), "--mirrored", "--steps", "1", "--out", "npt"]
    assert run(*POSE.split(), *options) == 0
    config = json.loads((posts / "npt" / "config.json").read_text())
    training, population = config["training"], config["population"]
    assert config["pose transfer"] == "npt" and config["settings"]["width"] == 32
    assert training["learning_rate"] == 0.01 and training["noise"] == 0.02
    assert training["seed"] == population["seed"] == 3
    assert population["identities"] == 2 and population["vertices"] == []
    assert population["limits"] == "wide" and training["mirrored"]


@pytest.mark.parametrize("option", [[], ["--by-vertex"]])
def test_means_over_the_surface_unless_told_otherwise(run, posts, option):
    out = "by_vertex" if option else "by_area"
    assert run(*POSE.split(), "--steps", "1", "--out", out, *option) == 0
    config = json.loads((posts / out / "config.json").read_text())
    assert config["settings"]["by_area"] == (not option)


@pytest.mark.parametrize(
    "command, words",
    [
        ("pose train --out x --steps 0", "--steps: 0"),
        ("pose train --out x --rate 0", "--rate: 0.0"),
        ("pose train --out x --people nobody", "nobody: folder: there is no such"),
        ("pose train --out x --network gan", "network: there is no 'gan'"),
        ("pose train --out x --width 3", "width: it is 3"),
        ("pose train --out x --identities 0", "identities: 0"),
        ("pose train --out x --vertices 2", "vertices: 2"),
        ("pose transfer egg.ply ball.obj o.fbx", "o.fbx: OUT: the name ends in"),
        ("pose transfer egg.ply ball.obj o.obj --model posts", "there is no such file"),
        ("pose transfer no.ply ball.obj o.obj --model small", "no.ply: file: there is"),
        ("pose transfer egg.ply ball.obj o.obj --reach -1", "--reach: -1.0"),
        ("pose evaluate posts", "model.safetensors: model: there is no such file"),
        ("pose evaluate small", "small: population: there is none"),
    ],
)
def test_bad_input_of_pose(run, posts, capsys, command, words):
    save_network(posts / "small", make_network("dsffnet", {"width": 32}, 0), {})
    assert run(*command.split()) == 2
    error = capsys.readouterr().err
    assert error.startswith("skinlib: ") and error.count("\n") == 1 and words in error
    assert not (posts / "o.obj").exists() and not (posts / "x").exists()


# ------------------------------------------------------------------------------ garment


@pytest.fixture(scope="module")
def wardrobe(place):
    """A small body with two garments and some poses in `place`; and what is wrong."""
    write_body(place / "post.npz", small_body())
    write_garment(place / "sleeve.npz", sleeve(0.115))
    write_garment(place / "band.npz", band())
    write_garment(place / "far.npz", replace(sleeve(5.0), name="far"))
    box = trimesh.creation.box()
    np.savez(place / "box.npz", vertices=box.vertices, faces=box.faces)
    motion = bends()
    write_motion(place / "bends.npz", motion)
    fields = {"bone_names": np.array(motion.bone_names), "fps": 30.0}
    np.savez(place / "nan.npz", rotations=0 * motion.rotations + np.nan, **fields)
    fields["bone_names"] = fields["bone_names"][:2]
    np.savez(place / "few.npz", rotations=motion.rotations[:, :2], **fields)
    return place


TRAIN = "garment train sleeve.npz --body post.npz --poses bends.npz --threads 1"


@pytest.fixture(scope="module")
def worn(wardrobe):
    """The name of a folder with a garment that was trained for two steps."""
    before = os.getcwd()
    os.chdir(wardrobe)
    try:
        cli.main([*TRAIN.split(), "--steps", "2", "--out", "worn"])
    finally:
        os.chdir(before)
    return "worn"


def test_train_a_garment_and_play_it(run, worn, capsys):
    command = f"garment play {worn} --poses bends.npz --out"
    assert run(*command.split(), "played.glb") == 0
    assert run(*command.split(), "played.npz") == 0
    assert "played.npz: 12 frames at 30 a second" in capsys.readouterr().out
    outfit, network = load_outfit(worn)
    with np.load("played.npz", allow_pickle=False) as file:
        assert np.array_equal(file["vertices"], outfit.pose(network, bends()))
        assert np.array_equal(file["faces"], outfit.faces)
    names = {node.name for node in pygltflib.GLTF2().load("played.glb").nodes}
    assert {"body", "sleeve", "hips", "spine", "chest"} <= names


def test_the_same_command_goes_on_and_another_does_not(run, worn, capsys):
    again = f"{TRAIN} --steps 2 --out {worn}"
    assert run(*again.split()) == 0
    assert run(*again.split(), "--seed", 1) == 2
    assert "worn: seed: another run" in capsys.readouterr().err


def test_options_of_garment_train_reach_the_training(run, wardrobe):
    command = TRAIN.replace("sleeve.npz", "sleeve.npz band.npz") + " --steps 1"
    assert run(*command.split(), "--out", "two", "--shapes", "--seed", 3) == 0
    training = json.loads((wardrobe / "two" / "config.json").read_text())["training"]
    assert (training["shapes"], training["seed"], training["steps"]) == (True, 3, 1)
    assert training["smoothing"] == 50  # the band is pinned
    outfit, network = load_outfit("two")
    assert [garment.name for garment in outfit.garments] == ["sleeve", "band"]
    play = "garment play two --poses bends.npz --out two.npz --ease 0.1"
    assert run(*play.split(), *"--shape wide 0.5 tall -0.25".split()) == 0
    with np.load("two.npz", allow_pickle=False) as file:
        expected = outfit.pose(network, bends(), {"wide": 0.5, "tall": -0.25}, 0.1)
        assert np.array_equal(file["vertices"], expected)
    for name, options, pinned, smoothing in (
        ("top", "--pin-top", 24, 50),
        ("above", "--pin-above 0.72 --smooth 3", 48, 3),
        ("free", "", 0, 10),
    ):
        command = f"{TRAIN} --steps 1 --out {name} {options}"
        assert run(*command.split()) == 0
        assert load_outfit(name)[0].pinned.sum() == pinned
        stored = json.loads((wardrobe / name / "config.json").read_text())
        assert stored["training"]["smoothing"] == smoothing


def test_a_garment_of_the_shipped_body_walks(run, wardrobe):
    """The shipped body and the shipped shirt, with poses of ours."""
    skeleton = read_body().head.skeleton
    still = Motion.create(np.zeros((2, len(skeleton), 3)), skeleton.names)
    write_motion(wardrobe / "still.npz", still)
    shirt = sample("t_shirt.npz")
    command = "--poses still.npz --steps 1 --threads 1 --out shirt"
    assert run("garment", "train", shirt, *command.split()) == 0
    assert run("garment", "play", "shirt", "--out", "walk.npz") == 0
    with np.load("walk.npz", allow_pickle=False) as file:
        assert file["vertices"].shape[1:] == load_outfit("shirt")[0].vertices.shape
        hem = file["vertices"][:, file["vertices"][0, :, 2].argmin()]
        assert np.ptp(hem, axis=0).max() > 0.005  # metres


def test_evaluate_a_garment(run, worn, capsys):
    command = f"garment evaluate {worn} --poses bends.npz --json worn.json"
    assert run(*command.split()) == 0
    out = capsys.readouterr().out
    with open("worn.json") as file:
        scores = json.load(file)
    assert list(scores) == ["skinning alone", "PBNS"]
    for name, numbers in scores.items():
        shown = ", ".join(f"{key} {value:.3f}" for key, value in numbers.items())
        assert f"{name}: {shown}" in out.splitlines()
        assert {"elongation", "inside", "deepest", "turned"} <= numbers.keys()


LOOSE = "garment train band.npz --body post.npz --simulated swung --bones 5 --threads 1"


@pytest.fixture(scope="module")
def swinging(wardrobe):
    """A folder of two simulations, and one that was trained with them."""
    rest = band().vertices
    for number in range(2):
        motion = smoothly(40, number)
        posed = motion.transforms(small_body().head.skeleton)[:, 1]
        posed = rest @ posed[:, :3, :3].swapaxes(1, 2) + posed[:, None, :3, 3]
        path = wardrobe / "swung" / f"motion_{number:04d}.npz"
        path.parent.mkdir(exist_ok=True)
        np.savez(
            path,
            rotations=motion.rotations,
            translations=motion.translations,
            bone_names=np.array(motion.bone_names),
            fps=motion.fps,
            name="sway",
            posed=posed.astype(np.float32),
            rest=rest,
        )
    before = os.getcwd()
    os.chdir(wardrobe)
    try:
        cli.main([*LOOSE.split(), "--steps", "2", "--out", "loose"])
    finally:
        os.chdir(before)
    return "loose"


def test_train_play_and_evaluate_on_virtual_bones(run, swinging, capsys):
    command = f"garment play {swinging} --poses bends.npz --out"
    assert run(*command.split(), "swung.glb") == 0
    assert run(*command.split(), "swung.npz") == 0
    loose = load_loose(swinging)
    assert len(loose.bones) == 5
    with np.load("swung.npz", allow_pickle=False) as file:
        assert np.array_equal(file["vertices"], loose.pose(bends()))
        assert np.array_equal(file["faces"], loose.garment.faces)
    names = {node.name for node in pygltflib.GLTF2().load("swung.glb").nodes}
    assert {"body", "band", "hips", "virtual_00", "virtual_04"} <= names
    capsys.readouterr()
    command = f"garment evaluate {swinging} --poses bends.npz --simulated swung"
    assert run(*command.split(), "--json", "loose.json") == 0
    out = capsys.readouterr().out
    with open("loose.json") as file:
        scores = json.load(file)
    distances = scores.pop("mm from the simulation")
    assert list(scores) == ["skinning alone", "virtual bones"]
    assert list(distances) == [
        *("skinning alone", "skinning, smooth", "rigid", "mean drape"),
        "virtual bones",
    ]
    for name, distance in distances.items():
        assert f"{name}: {distance:.1f} mm from the simulation" in out.splitlines()
    again = f"{LOOSE} --steps 2 --out {swinging}"
    assert run(*again.split()) == 0
    assert run(*again.split(), "--seed", 1) == 2


def test_simulate_a_garment(run, wardrobe, capsys):
    pytest.importorskip("warp")
    write_motion(wardrobe / "short.npz", smoothly(3))
    command = "garment simulate band.npz --body post.npz --poses short.npz --out few"
    assert run(*command.split()) == 0
    assert "--simulated few" in capsys.readouterr().out
    (found,) = read_simulations("few")
    assert found.posed.shape == (3, *band().vertices.shape)
    assert run(*command.split(), "--pin-above", 0.5) == 2
    assert "garment: another simulation" in capsys.readouterr().err


@pytest.mark.parametrize(
    "command, message",
    [
        (f"{TRAIN} --steps 0 --out bad", "--steps: 0. Give 1 or more"),
        (f"{LOOSE} --bones 0 --out bad", "--bones: 0. Give 1 or more"),
        (f"{LOOSE} --bones 999 --out bad", "bones: 999 virtual bones for 168"),
        (f"{LOOSE} --poses bends.npz --out bad", "--poses: given with --simulated"),
        (f"{LOOSE} --smooth 3 --out bad", "--smooth: given with --simulated"),
        (f"{LOOSE} --shapes --out bad", "--shapes: given with --simulated"),
        (f"{LOOSE.replace('swung', 'worn')} --out bad", "worn: simulated: there is no"),
        (f"{LOOSE.replace('band', 'sleeve')} --out bad", "Give the mesh that was"),
        (
            f"{LOOSE.replace('band.npz', 'sleeve.npz band.npz')} --out bad",
            "several garments",
        ),
        ("garment play loose --out a.glb --shape wide 0.5", "--shape: this garment"),
        ("garment play loose --out a.glb --ease 0.1", "--ease: this garment"),
        ("garment evaluate worn --simulated swung", "--simulated: this garment"),
        ("garment evaluate loose --simulated worn", "there is no simulation in it"),
        ("garment simulate no.npz --out bad", "no.npz: file: there is no"),
        ("garment simulate band.npz --motions 0 --out bad", "--motions: 0"),
        ("garment simulate band.npz --workers 0 --out bad", "--workers: 0"),
        ("garment simulate band.npz --seed -1 --out bad", "--seed: -1"),
        (
            "garment simulate band.npz --body post.npz --out bad",
            "has no clavicle.L",
        ),
        (f"{TRAIN} --seed -1 --out bad", "--seed"),
        (f"{TRAIN} --seed 99999999999999999999 --out bad", "--seed"),
        (f"{TRAIN} --smooth -1 --out bad", "--smooth"),
        (f"{TRAIN} --threads 0 --out bad", "--threads"),
        (f"{TRAIN} --device quantum --out bad", "quantum"),
        (f"{TRAIN} --pin-above 9 --out bad", "no vertex is above 9 m"),
        (f"{TRAIN} --body no.npz --out bad", "no.npz"),
        (f"{TRAIN} --body sleeve.npz --out bad", "sleeve.npz"),
        (f"{TRAIN} --poses no.npz --out bad", "no.npz: motion"),
        (f"{TRAIN} --poses nan.npz --out bad", "nan.npz: rotations: 12 frames hold N"),
        (f"{TRAIN} --poses few.npz --out bad", "a motion of 2 bones, a skeleton of 3"),
        (f"{TRAIN.replace('sleeve', 'no')} --out bad", "no.npz: file: there is no"),
        (f"{TRAIN.replace('sleeve', 'box')} --out bad", "box.npz: faces: 1 of 1 piec"),
        (f"{TRAIN.replace('sleeve', 'far')} --out bad", "away from the body"),
        (
            f"{TRAIN.replace('sleeve.npz', 'band.npz sleeve.npz')} --out bad",
            "lie inside band",
        ),
        ("garment train sleeve.npz --out bad", "vertices"),  # not the body's
        ("garment play no --out a.glb", "no/model.safetensors: outfit"),
        ("garment play worn --out a.fbx", "a.fbx: --out: '.fbx'. Name a .glb or"),
        ("garment play worn --out no/a.glb --poses bends.npz", "no/a.glb"),
        ("garment play worn --out no/a.npz --poses bends.npz", "no/a.npz"),
        ("garment play worn --out a.glb --poses wlak", "'wlak'. Name a .npz file, or"),
        ("garment play worn --out a.glb --poses few.npz", "a motion of 2 bones"),
        ("garment play worn --out a.glb --poses nan.npz", "nan.npz: rotations"),
        (
            "garment play worn --out a.glb --poses bends.npz --shape wide 0.5",
            "made for one body",
        ),
        ("garment play worn --out a.glb", "has no clavicle.L"),  # no walk for a post
        ("garment evaluate no", "no/model.safetensors: outfit"),
        ("garment evaluate worn --poses bends.npz --json no/a.json", "no: --json"),
    ],
)
def test_a_bad_garment_is_one_line_and_nothing_is_written(
    run, wardrobe, worn, swinging, capsys, command, message
):
    before = sorted(wardrobe.rglob("*"))
    capsys.readouterr()
    assert run(*command.split()) == 2
    stderr = capsys.readouterr().err
    assert message in stderr
    assert stderr.splitlines()[-1].startswith("skinlib: ")
    assert "Traceback" not in stderr
    assert sorted(wardrobe.rglob("*")) == before


def test_an_energy_that_is_not_finite_is_one_line(run, wardrobe, monkeypatch, capsys):
    monkeypatch.setattr(
        garment_training, "collision_energy", lambda points, *_: points[:, 0, 0] / 0
    )
    assert run(*TRAIN.split(), "--out", "diverged", "--steps", 2) == 2
    stderr = capsys.readouterr().err.splitlines()[-1]
    assert stderr.startswith("skinlib: the energy of step 0 is not finite")
    assert not list((wardrobe / "diverged").iterdir())


def test_a_group_says_what_it_is_for(run, capsys):
    assert run("garment", "--help") == 0
    text = capsys.readouterr().out
    assert "Learn how clothes move with a body" in text
    assert [word for word in ("train", "play", "evaluate") if word not in text] == []
    assert run("garment") == 2
    assert run("garment", "knit") == 2
    assert run("--help") == 0
    assert "garment" in capsys.readouterr().out


def test_scores_of_a_garment_appear_whole_or_not_at_all(run, worn, monkeypatch, capsys):
    with open("full.json", "w") as file:
        file.write("kept")

    def full(*names):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    command = f"garment evaluate {worn} --poses bends.npz --json full.json"
    assert run(*command.split()) == 2
    assert "No space left" in capsys.readouterr().err
    with open("full.json") as file:
        assert file.read() == "kept"


# ------------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    "command, message",
    [
        ("skin no.glb out.glb", "no.glb: file"),
        ("skin bare.npz out.obj", "out.obj"),
        ("skin bare.npz out.npz --checkpoint no/where", "no/where"),
        ("skin bare.npz out.npz --checkpoint network --painted bare", "has none"),
        ("skin bare.npz out.npz --checkpoint network --painted no", "no: folder"),
        ("skin bare.npz out.npz --max-influences 0", "--max-influences"),
        ("skin bare.npz out.npz --lock mouth_of_truth", "mouth_of_truth"),
        ("skin bare.npz out.npz --lock head", "no weights that could be kept"),
        (
            "skin heads/head_0.npz out.npz --lock-vertices _LOCKED",
            "heads/head_0.npz: _LOCKED: there is no such attribute",
        ),
        (
            "skin marked.npz out.npz --lock-vertices _LOCK",
            "_LOCK: there is no such attribute of the vertices, only locked",
        ),
        ("skin marked.npz out.npz --lock-vertices _LOCKED", "no weights that could"),
        (
            "skin full.npz out.npz --lock-vertices _LOCKED --max-influences 1",
            "full.npz: --max-influences: what is locked leaves vertex",
        ),
        ("skin bare.npz out.npz --smooth -1", "--smooth"),
        ("skin bare.npz nowhere/out.npz", "nowhere"),
        ("train --labelled nowhere --out new2", "nowhere"),
        ("train --labelled heads --out new2 --device quantum", "quantum"),
        ("train --labelled heads --out new2 --minutes -1", "--minutes"),
        ("train --labelled heads --out new2 --minutes nan", "--minutes"),
        ("train --labelled heads --out new2 --minutes inf", "--minutes"),
        ("train --labelled heads --out new2 --threads 0", "--threads"),
        ("train --labelled heads --out new2 --seed -1", "--seed"),
        ("train --labelled heads --out new2 --device meta", "meta"),
        ("train --labelled heads --out new2 --validation bare", "has none"),
        ("evaluate --heads network --checkpoint network", "network: folder"),
        (
            "evaluate --heads heads --checkpoint network --json no/where.json",
            "no: --json",
        ),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(
    run, place, capsys, command, message
):
    before = sorted(place.rglob("*"))
    if "--checkpoint" not in command and command.startswith("skin"):
        command += " --checkpoint network"
    assert run(*command.split()) == 2
    stderr = capsys.readouterr().err
    assert message in stderr
    assert stderr.splitlines()[-1].startswith("skinlib: ")
    assert "Traceback" not in stderr
    assert sorted(place.rglob("*")) == before


def test_scores_appear_whole_or_not_at_all(run, place, monkeypatch, capsys):
    (place / "old.json").write_text("kept")

    def full(*names):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    command = ("evaluate", "--heads", "heads", "--checkpoint", "network")
    assert run(*command, "--json", "old.json") == 2
    assert "No space left" in capsys.readouterr().err
    assert (place / "old.json").read_text() == "kept"


def test_a_target_that_cannot_be_written_is_told_before_the_work(run, monkeypatch):
    monkeypatch.setattr(SkinningModel, "predict", None)
    assert run("skin", "bare.npz", "no/out.glb", "--checkpoint", "network") == 2
    assert run("skin", "bare.npz", "out.obj", "--checkpoint", "network") == 2


def test_more_weights_than_a_file_holds_are_one_error(run, monkeypatch, capsys):
    monkeypatch.setattr(gltf, "MAX_ELEMENTS", 5000)
    assert run("skin", "bare.npz", "out.npz", "--checkpoint", "network") == 2
    assert "vertices times 11 bones are too many" in capsys.readouterr().err


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere names are text")
def test_a_file_name_that_is_no_text(run, place):
    name = os.fsdecode(b"caf\xe9.glb")
    (place / name).write_bytes((place / "skinned.glb").read_bytes())
    assert run("skin", name, "new_" + name, "--checkpoint", "network") == 0
    assert (place / ("new_" + name)).is_file()


def test_a_bar_in_a_log_file_is_a_few_lines(place):
    command = [sys.executable, "-m", "skinlib", "train", "--labelled", "heads"]
    command += "--out logged --start network --minutes 0.03".split()
    log = subprocess.run(command, capture_output=True, cwd=place).stderr
    assert 1 <= log.count(b"\r") <= 4


# -------------------------------------------------------------------------- demo, check


def test_demo(place, monkeypatch, capsys):
    monkeypatch.setattr(demo, "DEFAULT_CHECKPOINT", str(place / "network"))
    demo.run_demo(place / "demo")
    printed = capsys.readouterr().out
    assert all(name in printed for name in ("skinlib", "bone_heat", "robust_transfer"))
    artist = read_head(demo.sample(demo.HEAD))
    written = read_head(place / "demo" / "adult_skinned.glb")
    predicted = load_model(place / "network").predict(artist)
    np.testing.assert_allclose(written.weights, predicted, atol=1e-6)
    assert (place / "demo" / "demo.png").stat().st_size > 20_000


def test_check_finds_bad_packages(monkeypatch):
    lines = ["numpy>=1", "scipy>=99", "no-such>=1", 'nor-this; extra == "notebooks"']
    monkeypatch.setattr(check, "requires", lambda name: lines)
    found = {finding.what: finding.status for finding in check.package_findings()}
    assert found == {
        "numpy": "OK",
        "scipy": "FAIL",
        "no-such": "FAIL",
        "nor-this": "NOTE",
    }


def test_check_finds_a_changed_sample(tmp_path, monkeypatch):
    sums = tmp_path / "SHA256SUMS"
    monkeypatch.setattr(
        check, "repository_file", lambda _, *name: tmp_path.joinpath(*name)
    )
    # printf abc | sha256sum
    digest = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    sums.write_text(f"{digest}  head.npz\n")
    assert check._checksums("data_samples").status == "FAIL"
    (tmp_path / "head.npz").write_bytes(b"abd")
    assert "head.npz changed" in check._checksums("data_samples").detail
    (tmp_path / "head.npz").write_bytes(b"abc")
    assert check._checksums("data_samples").status == "OK"


def test_check_ends_with_1_when_something_fails(run, monkeypatch, capsys):
    findings = [check.Finding("OK", "numpy", "2"), check.Finding("NOTE", "vtk", "none")]
    monkeypatch.setattr(check, "run_checks", lambda: findings)
    assert run("check") == 0
    findings.append(check.Finding("FAIL", "torch", "missing"))
    assert run("check") == 1
    assert capsys.readouterr().out.splitlines()[-1].startswith("FAIL  torch")


def test_lab_is_served_where_it_is_asked_for(run, monkeypatch, capsys):
    from skinlib.views import lab

    calls = []
    monkeypatch.setattr(lab, "serve", lambda *options: calls.append(options))
    assert run("lab") == run("lab", "--port", 9000, "--no-browser") == 0
    assert calls == [(8866, True), (9000, False)]
    assert run("lab", "--port", 0) == 2
    assert "--port" in capsys.readouterr().err
