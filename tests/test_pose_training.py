"""Pose transfer: who takes part, training that resumes, and meshes that are posed."""

import json

import numpy as np
import pytest
import torch
import trimesh
from test_body import small_body

from skinlib.garments.motion import JOINTS, Motion, joint_axes
from skinlib.geometry import mesh_edges
from skinlib.head import HeadError
from skinlib.io import write_head
from skinlib.pose_transfer import training
from skinlib.pose_transfer.data import Cast, PosePairs, drawn_bodies
from skinlib.pose_transfer.metrics import edge_error
from skinlib.pose_transfer.networks import NETWORKS, parameter_kb
from skinlib.pose_transfer.population import (
    NPT_LIMITS,
    STRAIGHT,
    Population,
    expressions,
    judging,
    npt_poses,
    pairs,
)
from skinlib.pose_transfer.training import (
    TransferConfig,
    TransferTrainer,
    load_network,
    make_network,
    save_network,
    train,
)
from skinlib.pose_transfer.transfer import (
    judge,
    read_mesh,
    transfer_file,
    transfer_pose,
    write_mesh,
)
from skinlib.training.checkpoint import CONFIG, STATE, WEIGHTS

BODY = small_body()
SMALL = {"width": 32, "encoder": 8}
TURNS = np.random.default_rng(0).uniform(-0.5, 0.5, (12, 3, 3))
POSTS = Cast(drawn_bodies(BODY, 4), Motion.create(TURNS, BODY.head.skeleton.names))
TEN = TransferConfig(settings=SMALL, steps=10, threads=1)


@pytest.fixture(scope="module")
def few() -> Population:
    return Population(vertices=(200, 120), identities=2, judges=3, poses=4)


# ----------------------------------------------------------------- who takes part


def test_a_population_has_its_meshes_identities_and_poses(few):
    casts = few.casts("train")
    assert [cast.rest.shape[0] for cast in casts] == [2, 2]
    for cast, count in zip(casts, few.vertices, strict=True):
        assert abs(cast.rest.shape[1] - count) <= 0.05 * count
        assert cast.poses == 4


def test_judges_are_others_on_the_same_meshes_in_old_and_new_poses(few):
    for mine, other in zip(few.casts("train"), few.casts("judge"), strict=True):
        assert other.poses == 8 and len(other) == 3
        assert torch.equal(mine.faces, other.faces)
        assert not torch.allclose(mine.rest[0], other.rest[0], atol=1e-3)
        # The same rotations, each about the joints of somebody else.
        old, new = mine.transforms[0, :4, :, :3, :3], other.transforms[0, :8, :, :3, :3]
        torch.testing.assert_close(old, new[:4])
        assert not torch.allclose(old, new[4:], atol=1e-2)


def test_a_population_follows_from_its_seed(few):
    again = Population(vertices=(200, 120), identities=2, judges=3, poses=4)
    other = Population(vertices=(200, 120), identities=2, judges=3, poses=4, seed=1)
    rest = [p.casts("train")[0].rest for p in (few, again, other)]
    assert torch.equal(rest[0], rest[1])
    assert rest[0].shape != rest[2].shape or not torch.equal(rest[0], rest[2])


def test_heads_of_a_folder_every_fourth_judges(tmp_path):
    for number, head in enumerate(drawn_bodies(BODY, 5)):
        write_head(tmp_path / f"{number}.npz", head)
    folder = Population(str(tmp_path), (), poses=3)
    names = [[head.name for head in folder.heads(part)] for part in ("train", "judge")]
    assert names == [["0", "1", "2", "4"], ["3"]]
    cast = folder.casts("train")[0]
    assert cast.rest.shape == (4, len(BODY.head.vertices), 3)
    assert not torch.allclose(cast.transforms[0, 0], cast.transforms[0, 1])


def test_people_who_share_no_mesh(tmp_path):
    write_head(tmp_path / "a.npz", BODY.head)
    write_head(tmp_path / "b.npz", BODY.head.replace(faces=BODY.head.faces[::-1]))
    with pytest.raises(HeadError, match="people: b has other triangles or bones"):
        Population(str(tmp_path), ()).casts("train")
    write_head(tmp_path / "b.npz", BODY.head.replace(weights=None))
    with pytest.raises(HeadError, match="weights: b has none"):
        Population(str(tmp_path), ()).casts("train")


@pytest.mark.parametrize(
    "change, field",
    [
        ({"identities": 0}, "identities"),
        ({"identities": 1001}, "identities: 1001. Give 1000 or fewer"),
        ({"judges": 0}, "judges"),
        ({"poses": 0}, "poses"),
        ({"seed": -1}, "seed"),
        ({"vertices": (3,)}, "vertices"),
    ],
)
def test_impossible_populations(change, field):
    with pytest.raises(HeadError, match=field):
        Population(**change)


def test_more_vertices_than_people_have():
    with pytest.raises(HeadError, match="vertices: 99999 for people who have 12272"):
        Population(vertices=(99_999,), identities=1).casts("train")


def test_a_population_is_read_from_what_a_run_tells(few):
    told = json.loads(json.dumps({"population": few.describe()}))
    assert Population.read(told, "x") == few
    for damaged in ({}, {"population": {"people": "anny"}}, {"population": 3}):
        with pytest.raises(HeadError, match=r"x: population: there is none"):
            Population.read(damaged, "x")


def test_poses_are_those_of_npt():
    skeleton = Population(vertices=()).heads("train")[0].skeleton
    poses = npt_poses(skeleton, 40, 0)
    axes = joint_axes(skeleton)["knee.L"]
    knee = skeleton.names.index("lowerleg01.L")
    angles = np.degrees(poses.rotations[:, knee] @ axes.T)
    assert np.abs(angles[:, 1:]).max() < 1e-3
    assert 0 <= angles[:, 0].min() and angles[1::2, 0].max() <= 10
    assert 80 < angles[::2, 0].max() <= 100
    np.testing.assert_array_equal(
        npt_poses(skeleton, 3, 0).rotations, poses.rotations[:3]
    )


def test_no_pose_of_npt_is_beyond_what_joints_can():
    for name, joint in JOINTS.items():
        plain = name.partition(".")[0]
        for limits in (NPT_LIMITS, NPT_LIMITS | STRAIGHT):
            for mine, full in zip(limits[plain], joint[:3], strict=True):
                assert full[0] <= mine[0] <= mine[1] <= full[1]


def test_expressions_turn_all_bones_but_the_roots():
    motion = expressions(BODY.head.skeleton, 500, 3, degrees=10)
    assert (motion.rotations[:, 0] == 0).all()
    spread = np.degrees(motion.rotations[:, 1:].std(axis=0))
    np.testing.assert_allclose(spread, 10, rtol=0.1)


def test_pairs_go_from_each_mesh_to_each(few):
    casts = few.casts("train")
    kinds = pairs(casts, 7, 0)
    assert [len(kind) for kind in kinds] == [2, 2, 2, 1]
    assert {(id(k.sources), id(k.targets)) for k in kinds} == {
        (id(a), id(b)) for a in casts for b in casts
    }
    assert sum(map(len, pairs(casts, 3, 0))) == 3


def test_half_of_the_judging_is_in_poses_that_were_learnt(few):
    seen, unseen = judging(few, 8)
    for kinds, low, high in ((seen, 0, 4), (unseen, 4, 8)):
        for kind in kinds:
            poses = kind.batch(range(len(kind))).who[:, [1, 3]]
            assert (low <= poses).all() and (poses < high).all()


# ---------------------------------------------------------------------- training


def test_training_learns(tmp_path):
    config = TransferConfig(settings=SMALL, steps=300, threads=1)
    network = train(config, [POSTS], tmp_path / "run")
    test = [PosePairs(POSTS, POSTS, 40, seed=9)]
    assert judge(network, test).pmd < 0.6 * judge(None, test).pmd


def test_a_run_ends_in_the_same_bits_after_an_interrupt(tmp_path):
    whole = train(TEN, [POSTS], tmp_path / "whole")
    trainer = TransferTrainer(TEN, [POSTS], tmp_path / "parts")
    step, stops = trainer.step, iter([None, None, None, KeyboardInterrupt])

    def interrupted():
        if stop := next(stops):
            raise stop
        return step()

    trainer.step = interrupted
    with pytest.raises(KeyboardInterrupt):
        trainer.run()
    assert not (tmp_path / "parts" / WEIGHTS).exists()
    parts = train(TEN, [POSTS], tmp_path / "parts")
    for name, value in whole.state_dict().items():
        assert torch.equal(value, parts.state_dict()[name]), name
    again = train(TEN, [POSTS], tmp_path / "parts")
    assert torch.equal(again.convs[0].weight, whole.convs[0].weight)


@pytest.mark.parametrize(
    "change",
    [
        {"learning_rate": 1e-4},
        {"seed": 1},
        {"network": "npt"},
        {"noise": 0.1},
        {"mirrored": True},
    ],
)
def test_another_run_in_the_same_folder(tmp_path, change):
    train(TEN, [POSTS], tmp_path)
    changed = TransferConfig(**{"settings": SMALL, "steps": 10, "threads": 1} | change)
    with pytest.raises(HeadError, match=f"{next(iter(change))}.*another run"):
        train(changed, [POSTS], tmp_path)


def test_other_people_in_the_same_folder(tmp_path):
    train(TEN, [POSTS], tmp_path)
    others = Cast(
        drawn_bodies(BODY, 4, seed=1), Motion.create(TURNS, BODY.head.skeleton.names)
    )
    with pytest.raises(HeadError, match="people: another run"):
        train(TEN, [others], tmp_path)


def test_the_rate_falls_as_often_as_it_says(tmp_path):
    config = TransferConfig(settings=SMALL, steps=10, falls=5, threads=1)
    trainer = TransferTrainer(config, [POSTS], tmp_path)
    rates = []
    for _ in range(10):
        trainer.step()
        rates.append(trainer.optimizer.param_groups[0]["lr"])
    np.testing.assert_allclose(rates, 2e-3 * 0.8 ** np.repeat(np.arange(5), 2))


def test_else_the_rate_rises_and_falls(tmp_path):
    config = TransferConfig(settings=SMALL, steps=100, threads=1)
    trainer = TransferTrainer(config, [POSTS], tmp_path)
    rates = [trainer._fallen(step / 100) for step in range(101)]
    assert rates[0] == pytest.approx(0.1) and rates[-1] == pytest.approx(0.01)
    assert np.argmax(rates) == 9
    assert np.diff(rates[:10]).min() > 0 > np.diff(rates[10:]).max()


def test_all_meshes_take_part(tmp_path, few):
    trainer = TransferTrainer(TEN, few.casts("train"), tmp_path)
    assert len(trainer.pairs) == 4
    seen = set()
    for kind in trainer.pairs:
        batch = kind.batch

        def noted(items, batch=batch, kind=kind):
            seen.add(id(kind))
            return batch(items)

        kind.batch = noted
    for _ in range(20):
        trainer.step()
    assert len(seen) == 4


def test_every_second_step_is_in_a_mirror(tmp_path):
    config = TransferConfig(settings=SMALL, steps=4, threads=1, mirrored=True)
    trainer = TransferTrainer(config, [POSTS], tmp_path)
    network, given = trainer.network, []

    class Noted(torch.nn.Module):
        def forward(self, source, identity, *shares):
            given.append((source, identity))
            return network(source, identity, *shares)

    trainer.network = Noted()
    told = [trainer.step() for _ in range(2)]
    for step, sign in ((0, 1), (1, -1)):
        pairs = trainer.pairs[0].batch(range(8 * step, 8 * step + 8))
        mirror = torch.tensor([sign, 1, 1])
        assert torch.equal(given[step][0], pairs.source * mirror)
        assert torch.equal(given[step][1], pairs.identity * mirror)
    with torch.no_grad():
        pairs = PosePairs(POSTS, POSTS, 8)
        first = make_network("dsffnet", SMALL, 0)
        items = pairs.batch(range(8))
        off = first(*items.inputs) - items.truth
    assert told[0]["PMD e-4"] == pytest.approx(
        1e4 * off.square().mean().item(), rel=1e-4
    )


def test_a_loss_that_is_no_number_stops_the_run(tmp_path):
    trainer = TransferTrainer(TEN, [POSTS], tmp_path)
    with torch.no_grad():
        trainer.network.convs[-1].bias.fill_(torch.nan)
    with pytest.raises(FloatingPointError, match="lower learning_rate"):
        trainer.step()


@pytest.mark.parametrize(
    "change",
    [
        {"network": "none"},
        {"steps": 0},
        {"batch": 0},
        {"threads": 0},
        {"falls": -1},
        {"edge_weight": -1.0},
        {"noise": float("nan")},
        {"seed": -1},
    ],
)
def test_impossible_configurations(change):
    with pytest.raises(HeadError, match=next(iter(change))):
        TransferConfig(**change)


def test_settings_that_a_network_does_not_have():
    with pytest.raises(HeadError, match=r"settings.*encoder"):
        make_network("corenet", {"encoder": 8}, 0)


def test_no_casts(tmp_path):
    with pytest.raises(HeadError, match="casts: there are none"):
        train(TEN, [], tmp_path)


def test_parameters_follow_from_the_seed():
    first, same, other = (
        make_network("dsffnet", SMALL, seed).convs[0].weight for seed in (0, 0, 1)
    )
    assert torch.equal(first, same) and not torch.equal(first, other)


# --------------------------------------------------------------------- on the disk


@pytest.mark.parametrize("name", NETWORKS)
def test_a_network_is_kept_with_what_is_told_of_it(tmp_path, name):
    network = make_network(name, {"width": 32}, 0).eval()
    save_network(tmp_path, network, {"seconds": 3})
    loaded, told = load_network(tmp_path)
    assert parameter_kb(loaded) == parameter_kb(network) and told["seconds"] == 3
    points = torch.rand(1, 20, 3) * 2 - 1
    with torch.inference_mode():
        given = points, points, *torch.full((2, 1, 20), 1 / 20)
        assert torch.equal(loaded(*given), network(*given))


def test_folders_without_a_network(tmp_path):
    with pytest.raises(HeadError, match="there is no such file"):
        load_network(tmp_path)
    (tmp_path / STATE).touch()
    with pytest.raises(HeadError, match="its training has not ended"):
        load_network(tmp_path)
    save_network(tmp_path, make_network("dsffnet", SMALL, 0), {})
    training.write_tensors(tmp_path / WEIGHTS, {}, {"config": "{}"})
    with pytest.raises(HeadError, match="no pose transfer"):
        load_network(tmp_path)
    (tmp_path / WEIGHTS).write_bytes(b"nothing")
    with pytest.raises(HeadError, match="cannot be read"):
        load_network(tmp_path)
    assert "settings" in json.loads((tmp_path / CONFIG).read_text())


# ------------------------------------------------------------------- one mesh posed


NETWORK = make_network("dsffnet", SMALL, 0).eval()
MESH = trimesh.creation.icosphere(2)
EDGES = mesh_edges(np.asarray(MESH.faces))


def at(vertices, order=None) -> trimesh.Trimesh:
    """The mesh with its vertices elsewhere, and in another order."""
    order = np.arange(len(vertices)) if order is None else order
    faces = np.argsort(order)[MESH.faces]
    return trimesh.Trimesh(vertices[order], faces, process=False)


def points(vertices) -> trimesh.Trimesh:
    """As many of the triangles as these vertices can have."""
    faces = MESH.faces[(MESH.faces < len(vertices)).all(axis=1)]
    return trimesh.Trimesh(vertices, faces, process=False)


def test_a_mesh_in_its_own_pose_stays_as_it_is():
    order = np.random.default_rng(0).permutation(len(MESH.vertices))
    larger = at(3 * MESH.vertices + 1)
    for source in (MESH, at(MESH.vertices, order), larger):
        posed = transfer_pose(NETWORK, source, MESH)
        np.testing.assert_array_equal(posed, MESH.vertices.astype(np.float32))


def test_the_result_stands_where_the_target_stood_in_its_size():
    source = at(MESH.vertices * [1, 2, 3])
    here = transfer_pose(NETWORK, source, MESH)
    there = transfer_pose(NETWORK, source, at(100 * MESH.vertices + [5, 6, 7]))
    np.testing.assert_allclose(there, 100 * here + [5, 6, 7], atol=2e-2)
    assert abs(here[:, 2].min() - MESH.vertices[:, 2].min()) < 1e-6
    middle = (here.min(0) + here.max(0)) / 2
    np.testing.assert_allclose(middle[:2], 0, atol=1e-6)
    raw = transfer_pose(NETWORK, source, MESH, reach=0)
    lengths = [
        np.linalg.norm(p[EDGES[:, 0]] - p[EDGES[:, 1]], axis=1)
        for p in (raw, MESH.vertices)
    ]
    assert abs((lengths[0] * lengths[1]).sum() / (lengths[0] ** 2).sum() - 1) < 1e-5
    off = [edge_error(points, MESH.vertices, EDGES) for points in (here, raw)]
    assert off[0] < 0.9 * off[1]  # an untrained network gives little to keep


def test_the_order_of_vertices_does_not_matter():
    rng = np.random.default_rng(1)
    source = MESH.vertices * [1, 2, 3]
    posed = transfer_pose(NETWORK, at(source), MESH)
    a, b = (rng.permutation(len(source)) for _ in range(2))
    again = transfer_pose(NETWORK, at(source, a), at(MESH.vertices, b))
    np.testing.assert_allclose(again, posed[b], atol=1e-5)


@pytest.mark.parametrize(
    "source, target, words",
    [
        (np.zeros((5, 3)), MESH.vertices, "source: all of them are at one place"),
        (MESH.vertices, np.full((5, 3), np.nan), "target: they hold NaN"),
        (np.zeros((1, 3)), MESH.vertices, "source"),
        (MESH.vertices, np.zeros((0, 3)), "target"),
    ],
)
def test_meshes_that_have_no_pose(source, target, words):
    with pytest.raises(HeadError, match=words):
        transfer_pose(NETWORK, points(source), points(target))


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply", ".stl"])
def test_a_mesh_is_written_as_it_was_read(tmp_path, suffix):
    file = tmp_path / f"mesh{suffix}"
    write_mesh(file, MESH)
    again = read_mesh(file)
    assert np.ptp(again.triangles - MESH.triangles) < 1e-5
    if suffix == ".glb":
        raw = trimesh.load_scene(file, process=False).to_mesh()
        np.testing.assert_allclose(raw.vertices[:, 1], MESH.vertices[:, 2], atol=1e-6)


def test_a_file_is_posed_with_its_triangles_and_texture(tmp_path):
    uv = np.random.default_rng(0).random((len(MESH.vertices), 2))
    target = trimesh.Trimesh(
        MESH.vertices,
        MESH.faces,
        visual=trimesh.visual.TextureVisuals(uv=uv),
        process=False,
    )
    target.export(tmp_path / "target.obj")
    source = MESH.copy()
    source.vertices *= [1, 2, 3]
    write_mesh(tmp_path / "source.glb", source)
    transfer_file(
        NETWORK, *(tmp_path / f for f in ("source.glb", "target.obj", "o.obj"))
    )
    posed = read_mesh(tmp_path / "o.obj")
    expected = transfer_pose(NETWORK, source, MESH)
    np.testing.assert_allclose(posed.vertices, expected, atol=1e-5)
    np.testing.assert_array_equal(posed.faces, MESH.faces)
    np.testing.assert_allclose(posed.visual.uv, uv, atol=1e-5)


def test_bad_files_are_named_and_nothing_is_written(tmp_path):
    write_mesh(tmp_path / "ball.obj", MESH)
    (tmp_path / "torn.glb").write_bytes(b"glTF")
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    (tmp_path / "nan.obj").write_text("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "dot.obj").write_text("v 1 1 1\n" * 3 + "f 1 2 3\n")
    (tmp_path / "text.txt").write_text("x")
    out = tmp_path / "out.obj"
    for bad in ("torn.glb", "points.obj", "nan.obj", "dot.obj", "text.txt", "no.obj"):
        for files in ((bad, "ball.obj"), ("ball.obj", bad)):
            with pytest.raises(HeadError, match=bad):
                transfer_file(NETWORK, *(tmp_path / file for file in files), out)
    for bad in (tmp_path / "out.txt", tmp_path / "nowhere" / "out.obj"):
        with pytest.raises(HeadError, match="OUT"):
            transfer_file(NETWORK, tmp_path / "ball.obj", tmp_path / "ball.obj", bad)
    assert not out.exists()


# -------------------------------------------------------------------------- judging


def test_the_judge_sees_the_truth_and_a_copy():
    class Truth(torch.nn.Module):
        def forward(self, *given):
            return self.truth

    test = PosePairs(POSTS, POSTS, 6)
    network, batch = Truth(), test.batch

    def noted(items):
        found = batch(items)
        network.truth = found.truth
        return found

    test.batch = noted
    found = judge(network, [test], batch=4)
    assert found.pmd == 0 and found.edge_error == 0 and found.vertex_error == 0
    copied = judge(None, [test])
    items = batch(range(6))
    expected = (items.identity - items.truth).square().mean().item()
    assert copied.pmd == pytest.approx(expected, rel=1e-5)
