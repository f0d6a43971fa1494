"""The energies of cloth: on two triangles by hand, their derivatives, invariances."""

from math import cos, inf, nan, pi, sin

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.autograd import gradcheck

from skinlib.garments.energies import (
    Cloth,
    EnergyWeights,
    bend_energy,
    collision_energy,
    edge_energy,
    face_normals,
    gravity_energy,
    pin_energy,
    total_energy,
)
from skinlib.head import HeadError

# Two right triangles with the sides 3, 4, 5 that share the long one, from 1 to 2.
SHEET = np.array([[0.0, 0, 0], [4, 0, 0], [0, 3, 0], [4, 3, 0]])
FACES = np.array([[0, 1, 2], [2, 1, 3]])
UP = torch.tensor([0.0, 0, 1], dtype=torch.float64)


def batch(*poses) -> torch.Tensor:
    return torch.from_numpy(np.stack(poses))


def folded(angle: float) -> np.ndarray:
    """The sheet with its second triangle turned about the shared side."""
    axis = np.array([-4.0, 3, 0]) / 5
    turned = SHEET.copy()
    turn = Rotation.from_rotvec(angle * axis)
    turned[3] = turn.apply(SHEET[3] - SHEET[1]) + SHEET[1]
    return turned


def grid(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """A square metre, two triangles a cell."""
    side = cells + 1
    ids = np.arange(side * side).reshape(side, side)
    a, b, c, d = ids[:-1, :-1], ids[:-1, 1:], ids[1:, :-1], ids[1:, 1:]
    faces = np.stack([a, b, d, a, d, c], axis=-1).reshape(-1, 3)
    y, x = np.divmod(ids.ravel(), side)
    return np.stack([x / cells, y / cells, 0 * x], axis=1), faces


@pytest.fixture
def cloth() -> Cloth:
    return Cloth(SHEET, FACES, density=0.5)


@pytest.fixture
def crumpled() -> torch.Tensor:
    """(3, 4, 3) poses without anything special about them."""
    noise = np.random.default_rng(0).normal(scale=0.3, size=(3, 4, 3))
    return torch.from_numpy(SHEET + noise)


# -- what never changes --------------------------------------------------------------


def test_the_springs_hinges_and_masses_of_two_triangles(cloth):
    lengths = dict(
        zip(map(tuple, cloth.edges.tolist()), cloth.rest_lengths.tolist(), strict=True)
    )
    expected = {(0, 1): 4, (0, 2): 3, (1, 2): 5, (1, 3): 3, (2, 3): 4}
    assert lengths == pytest.approx(expected)
    assert cloth.hinges.tolist() == [[0, 1]]
    assert cloth.hinge_edges.tolist() == [[1, 2]]  # face 0 runs from 1 to 2
    # Two faces of 6 m^2 at 0.5 kg/m^2 weigh 6 kg; the middle vertices have two thirds.
    assert cloth.masses.tolist() == pytest.approx([1, 2, 2, 1])


def test_the_hinges_of_a_grid():
    vertices, faces = grid(4)
    cloth = Cloth(vertices, faces)
    # E = inner + boundary: 3 F = 2 inner + boundary.
    assert len(cloth.hinges) == len(cloth.edges) - 4 * 4
    for (a, b), edge in zip(cloth.hinges, cloth.hinge_edges, strict=True):
        shared = set(faces[a]) & set(faces[b])
        assert shared == set(edge.tolist())
        assert edge.tolist() in np.stack([faces[a], np.roll(faces[a], -1)], 1).tolist()
    assert cloth.masses.sum().item() == pytest.approx(0.30)


def test_read_only_arrays_of_a_garment_do():
    vertices, faces = SHEET.astype(np.float32), FACES.copy()
    vertices.flags.writeable = faces.flags.writeable = False
    assert Cloth(vertices, faces).rest_lengths.dtype == torch.float32


def test_it_moves_as_a_whole_and_is_not_saved_with_a_model(cloth):
    moved = cloth.to("meta")
    assert {buffer.device.type for buffer in moved.buffers()} == {"meta"}
    assert len(list(moved.buffers())) == 6 and not moved.state_dict()


@pytest.mark.parametrize(
    "faces",
    [
        pytest.param([[0, 1, 2], [1, 2, 3]], id="turned the other way"),
        pytest.param([[0, 1, 2], [2, 1, 3], [1, 2, 4]], id="three faces at an edge"),
    ],
)
def test_an_edge_has_two_faces_that_turn_the_same_way(faces):
    vertices = np.concatenate([SHEET, [[0.0, 0, 9]]])
    with pytest.raises(HeadError, match="from vertex 1 to 2"):
        Cloth(vertices, np.array(faces))


@pytest.mark.parametrize("density", [0.0, -1.0, nan, inf])
def test_cloth_weighs_something(density):
    with pytest.raises(HeadError, match="density"):
        Cloth(SHEET, FACES, density)


# -- by hand -------------------------------------------------------------------------


def test_normals_by_hand(cloth):
    normals = face_normals(batch(SHEET, folded(pi / 2)), cloth.faces)
    np.testing.assert_allclose(normals[0], [[0, 0, 1]] * 2, atol=1e-12)
    np.testing.assert_allclose(normals[1, 1], [0.6, 0.8, 0], atol=1e-12)
    assert normals[1, 1] @ normals[1, 0] == pytest.approx(0, abs=1e-12)


def test_edge_energy_by_hand(cloth):
    doubled = edge_energy(batch(2 * SHEET), cloth)  # 3^2 + 3^2 + 4^2 + 4^2 + 5^2
    assert doubled.item() == pytest.approx(75)
    lifted = SHEET.copy()
    lifted[3, 2] = 4  # edges of 3 and 4 become 5 and sqrt(32)
    expected = (5 - 3) ** 2 + (32**0.5 - 4) ** 2
    assert edge_energy(batch(lifted), cloth).item() == pytest.approx(expected)


def test_no_edge_is_stretched_at_rest():
    energy = edge_energy(batch(SHEET / 3), Cloth(SHEET / 3, FACES))
    assert energy.item() == pytest.approx(0, abs=1e-20)


@pytest.mark.parametrize(
    ("degrees", "energy"), [(0, 0), (60, 1), (90, 2), (-90, 2), (180, 4)]
)
def test_bend_energy_by_hand(cloth, degrees, energy):
    pose = batch(folded(np.radians(degrees)))
    assert bend_energy(pose, cloth).item() == pytest.approx(energy, abs=1e-12)
    assert edge_energy(pose, cloth).item() == pytest.approx(0, abs=1e-20)


def test_collision_energy_by_hand():
    heights = torch.tensor([[0.010, 0.004, 0.001, 0.0, -0.006]], dtype=torch.float64)
    points = torch.zeros(1, 5, 3, dtype=torch.float64)
    cloth = points + heights[..., None] * UP
    cloth[..., 0] = 7  # along the surface nothing counts
    found = collision_energy(cloth, points, UP.expand(1, 5, 3))
    assert found.item() == pytest.approx(0.003**2 + 0.004**2 + 0.010**2)
    assert collision_energy(cloth, points, UP.expand(1, 5, 3), 0.0).item() == (
        pytest.approx(0.006**2)
    )


def test_collision_pushes_outwards_and_only_near_the_body():
    heights = torch.tensor([0.005, 0.003, -0.010], dtype=torch.float64)
    cloth = (heights[:, None] * UP)[None].requires_grad_()
    body = torch.zeros(1, 3, 3, dtype=torch.float64)
    collision_energy(cloth, body, UP.expand(1, 3, 3)).sum().backward()
    expected = -2 * torch.tensor([0, 0.001, 0.014]).double()[:, None] * UP
    np.testing.assert_allclose(cloth.grad[0], expected, atol=1e-12)


def test_gravity_energy_by_hand(cloth):
    # 6 kg, whose centre is 1.5 m up the Y axis.
    assert gravity_energy(batch(SHEET), cloth, up=1).item() == pytest.approx(
        9.81 * 6 * 1.5
    )
    assert gravity_energy(batch(SHEET), cloth).item() == 0


def test_pin_energy_by_hand():
    offsets = torch.tensor([[[1.0, 2, 2], [5, 5, 5], [0, 0, -1]]])
    pinned = torch.tensor([True, False, True])
    assert pin_energy(offsets, pinned).tolist() == [10]
    assert pin_energy(offsets, ~pinned).tolist() == [75]
    assert pin_energy(offsets, torch.zeros(3, dtype=torch.bool)).tolist() == [0]


# -- derivatives ---------------------------------------------------------------------


def test_derivatives(cloth, crumpled):
    poses = crumpled.requires_grad_()
    normals = torch.nn.functional.normalize(crumpled.detach(), dim=-1)
    assert gradcheck(face_normals, (poses, cloth.faces))
    assert gradcheck(lambda p: edge_energy(p, cloth), poses)
    assert gradcheck(lambda p: bend_energy(p, cloth), poses)
    assert gradcheck(lambda p: gravity_energy(p, cloth), poses)
    assert gradcheck(lambda p: pin_energy(p, torch.tensor([True, False] * 2)), poses)
    # Some of the vertices are inside, and an inner layer is moved as well.
    body = (poses.detach() + 0.1 * normals.flip(1)).requires_grad_()
    assert collision_energy(poses, body, normals).gt(0).all()
    assert gradcheck(lambda p, b: collision_energy(p, b, normals), (poses, body))


@pytest.mark.parametrize(
    "pose",
    [
        pytest.param(SHEET[[0, 0, 2, 3]], id="an edge of length 0"),
        pytest.param(SHEET * [1, 0, 0], id="triangles without area"),
        pytest.param(SHEET * 0, id="a point"),
    ],
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_degenerate_cloth_has_finite_derivatives(cloth, pose, dtype):
    pose = batch(pose).to(dtype).requires_grad_()
    energy = edge_energy(pose, cloth) + 5e-5 * bend_energy(pose, cloth)
    energy.sum().backward()
    assert energy.isfinite().all() and pose.grad.isfinite().all()


def test_a_triangle_without_area_has_no_normal(cloth):
    assert face_normals(batch(SHEET * 0), cloth.faces).count_nonzero() == 0
    # One of 1 mm has one, of nearly full length.
    lengths = face_normals(batch(SHEET * 1e-3), cloth.faces).norm(dim=-1)
    np.testing.assert_allclose(lengths, 1, atol=1e-6)


# -- what changes nothing, and what does ---------------------------------------------


def test_a_rigid_motion_changes_only_the_height(cloth, crumpled):
    turn = torch.from_numpy(Rotation.random(rng=1).as_matrix())
    shift = torch.tensor([1.0, -2, 3], dtype=torch.float64)
    moved = crumpled @ turn.T + shift
    for energy in (edge_energy, bend_energy):
        torch.testing.assert_close(energy(moved, cloth), energy(crumpled, cloth))
    lifted = gravity_energy(crumpled + shift, cloth) - gravity_energy(crumpled, cloth)
    np.testing.assert_allclose(lifted, 6 * 9.81 * 3)  # m g h


def test_a_batch_is_its_poses_one_by_one(cloth, crumpled):
    for energy in (edge_energy, bend_energy, gravity_energy):
        alone = [energy(pose[None], cloth) for pose in crumpled]
        torch.testing.assert_close(energy(crumpled, cloth), torch.cat(alone))


def test_a_finer_mesh_has_the_same_edge_and_bend_energy():
    def energies(cells: int) -> tuple[float, float]:
        vertices, faces = grid(cells)
        x, y, _ = vertices.T
        tube = [[1.1 * sin(t), v, 1 - 1.1 * cos(t)] for t, v in zip(x, y, strict=True)]
        pose, cloth = batch(tube), Cloth(vertices, faces)
        return edge_energy(pose, cloth).item(), bend_energy(pose, cloth).item()

    coarse, fine = energies(20), energies(40)
    assert coarse == pytest.approx(fine, rel=0.06)
    assert min(fine) > 0.01


def test_precision_is_kept(cloth, crumpled):
    single = crumpled.float()
    for energy in (edge_energy, bend_energy, gravity_energy):
        assert energy(single, cloth).dtype == torch.float32
        assert energy(crumpled, Cloth(SHEET.astype(np.float32), FACES)).dtype == (
            torch.float64
        )
        np.testing.assert_allclose(
            energy(single, cloth), energy(crumpled, cloth), rtol=1e-5
        )
    assert face_normals(single, cloth.faces).dtype == torch.float32
    assert pin_energy(single, torch.ones(4, dtype=torch.bool)).dtype == torch.float32
    assert collision_energy(single, single, single).dtype == torch.float32


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_the_device_is_kept(cloth, crumpled):
    expected = [edge_energy(crumpled, cloth), bend_energy(crumpled, cloth)]
    cloth, crumpled = cloth.cuda(), crumpled.cuda()
    found = [edge_energy(crumpled, cloth), bend_energy(crumpled, cloth)]
    assert all(energy.device.type == "cuda" for energy in found)
    torch.testing.assert_close([energy.cpu() for energy in found], expected)


# -- the sum -------------------------------------------------------------------------


def test_total_energy_by_hand():
    terms = {
        "edge": torch.tensor([1.0, 2.0]),
        "gravity": torch.tensor([-3.0, 4.0]),
        "layer": torch.tensor([0.1, 0.2]),
    }
    weights = EnergyWeights(edge=2, gravity=0.5, layer=10)
    assert total_energy(terms, weights).tolist() == pytest.approx([1.5, 8])


def test_a_weight_of_0_switches_a_term_off():
    terms = {"edge": torch.tensor([1.0]), "bend": torch.tensor([nan])}
    assert total_energy(terms, EnergyWeights(edge=2, bend=0)).tolist() == [2]
    assert total_energy(terms, EnergyWeights(edge=0, bend=0)).tolist() == [0]


def test_a_term_needs_a_weight():
    with pytest.raises(ValueError, match="stretch"):
        total_energy({"stretch": torch.zeros(1)}, EnergyWeights())
    with pytest.raises(ValueError, match="no terms"):
        total_energy({}, EnergyWeights())


@pytest.mark.parametrize("value", [-1.0, nan, inf])
@pytest.mark.parametrize("name", ["edge", "layer"])
def test_weights_are_0_or_more(name, value):
    with pytest.raises(HeadError, match=f"weight of {name}"):
        EnergyWeights(**{name: value})
