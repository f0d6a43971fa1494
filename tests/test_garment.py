"""What is a garment, what is not, and how one gets in and out of files."""

import numpy as np
import pytest
import trimesh

from skinlib.garments.garment import (
    PINNED,
    Garment,
    boundary_loops,
    pin_boundary,
    read_garment,
    write_garment,
)
from skinlib.head import HeadError


def tube(rings: int = 4, segments: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """A vertical tube of radius 1, facing outwards, its first ring at z = 0."""
    angle = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    vertices = np.concatenate(
        [np.column_stack([ring, np.full(segments, z)]) for z in range(rings)]
    )
    a = np.arange((rings - 1) * segments).reshape(rings - 1, segments)
    b = np.roll(a, -1, axis=1)
    c, d = a + segments, b + segments
    faces = np.stack([[a, b, d], [a, d, c]]).reshape(2, 3, -1)
    return vertices, np.concatenate(faces.transpose(0, 2, 1))


@pytest.fixture
def garment() -> Garment:
    vertices, faces = tube()
    return Garment.create(vertices, faces, vertices[:, 2] > 2.5, "tube")


def same(a: Garment, b: Garment) -> bool:
    return (
        np.allclose(a.vertices, b.vertices, atol=1e-6)
        and np.array_equal(a.faces, b.faces)
        and np.array_equal(a.pinned, b.pinned)
    )


def test_a_tube_is_a_garment(garment):
    assert garment.vertices.dtype == np.float32 and garment.faces.dtype == np.int64
    assert garment.pinned.tolist() == [False] * 24 + [True] * 8
    with pytest.raises(ValueError, match="read-only"):
        garment.vertices[0] = 0


def test_the_caller_keeps_his_own_arrays():
    vertices, faces = tube()
    vertices, pinned = vertices.astype(np.float32), np.zeros(len(vertices), bool)
    garment = Garment.create(vertices, faces, pinned)
    vertices[:], pinned[:] = 7, True
    assert garment.vertices[0].tolist() == [1, 0, 0] and not garment.pinned.any()


def test_several_pieces_are_a_garment():
    vertices, faces = tube()
    both = np.concatenate([vertices, vertices + np.array([5, 0, 0])])
    garment = Garment.create(both, np.concatenate([faces, faces + len(vertices)]))
    assert len(boundary_loops(garment.faces)) == 4


def broken(kind: str) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = tube()
    if kind == "nan":
        vertices[5, 1] = np.nan
    elif kind == "range":
        faces[0, 0] = 99
    elif kind == "few":
        faces = faces[:2]
    elif kind == "fin":
        vertices = np.concatenate([vertices, [[3, 0, 0]]])
        faces = np.concatenate([faces, [[9, 1, len(vertices) - 1]]])
    elif kind == "flat":
        vertices[8] = (vertices[0] + vertices[16]) / 2
        faces = np.concatenate([faces, [[0, 8, 16]]])
    elif kind == "inside out":
        faces[3] = faces[3, ::-1]
    elif kind == "closed":
        box = trimesh.creation.box()
        vertices, faces = np.asarray(box.vertices), np.asarray(box.faces)
    elif kind == "two fans":
        vertices = np.concatenate([vertices, [[2, 0, 0], [2, 1, 0]]])
        faces = np.concatenate([faces, [[0, 32, 33]]])
    return vertices, faces


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("nan", "vertices: vertex 5 has NaN or infinity"),
        ("range", "faces: ids from 0 to 99 for 32 vertices"),
        ("few", "faces: 2 triangles. Give at least 3"),
        ("fin", r"1 edges belong to 3 or more.*vertices 1 and 9 at \(0.707, 0.707, 0"),
        ("flat", "1 triangles have no area, the first is triangle 48. Dissolve degen"),
        ("inside out", "triangles face both ways at [23] edges.*Recalculate the norm"),
        ("closed", "1 of 1 pieces have no open edge. Delete the inner layer"),
        ("two fans", r"1 vertices join parts .* vertex 0 at \(1.000, 0.000, 0.000\)"),
    ],
)
def test_what_is_no_cloth_is_refused(kind, message):
    with pytest.raises(HeadError, match=message):
        Garment.create(*broken(kind), file="shirt.glb")


def test_an_error_names_the_file():
    with pytest.raises(HeadError, match=r"^shirt.glb: vertices"):
        Garment.create(*broken("nan"), file="shirt.glb")


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("vertices", {"vertices": np.zeros((4, 2))}),
        ("vertices", {"vertices": np.full((4, 3), "x")}),
        ("faces", {"faces": np.zeros((4, 3))}),
        ("faces", {"faces": np.zeros((4, 4), int)}),
        ("pinned", {"pinned": np.zeros(3, bool)}),
        ("pinned", {"pinned": np.zeros(32)}),
    ],
)
def test_arrays_of_another_kind_are_refused(field, change):
    vertices, faces = tube()
    with pytest.raises(HeadError, match=f"^{field}: "):
        Garment.create(**({"vertices": vertices, "faces": faces} | change))


@pytest.mark.parametrize("ending", [".npz", ".glb", ".obj"])
def test_a_garment_comes_back_from_a_file(tmp_path, garment, ending):
    path = tmp_path / f"tube{ending}"
    if ending == ".obj":
        garment = Garment.create(garment.vertices, garment.faces)
    write_garment(path, garment)
    back = read_garment(path)
    assert back.name == "tube"
    if ending == ".npz":
        assert same(back, garment)
    assert sorted(map(tuple, back.vertices[back.pinned].round(4))) == sorted(
        map(tuple, garment.vertices[garment.pinned].round(4))
    )
    # A mesh file may number the vertices anew.
    triangles = [
        sorted(sorted(map(tuple, t)) for t in g.vertices[g.faces].round(4).tolist())
        for g in (back, garment)
    ]
    assert triangles[0] == triangles[1]


def test_the_same_garment_is_the_same_file(tmp_path, garment):
    write_garment(tmp_path / "a.npz", garment)
    write_garment(tmp_path / "b.npz", garment)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_a_gltf_file_is_y_up(tmp_path, garment):
    """The top of the garment, at z = 3 here, is at y = 3 there."""
    write_garment(tmp_path / "tube.glb", garment)
    mesh = trimesh.load_mesh(tmp_path / "tube.glb", process=False)
    top = mesh.vertex_attributes[PINNED].ravel() > 0.5
    assert np.allclose(mesh.vertices[top, 1], 3) and np.allclose(
        mesh.vertices[~top, 1].max(), 2
    )


def test_a_mesh_file_is_welded_turned_and_rid_of_loose_vertices(tmp_path, garment):
    """Each triangle with vertices of its own, three of them inside out."""
    corners = garment.vertices[garment.faces]
    corners[[2, 5, 7]] = corners[[2, 5, 7]][:, ::-1]
    vertices = np.concatenate([[[9, 9, 9]], corners.reshape(-1, 3)])
    faces = 1 + np.arange(corners.size // 3).reshape(-1, 3)
    soup = trimesh.Trimesh(vertices, faces, process=False)
    for ending in (".ply", ".obj", ".stl"):
        path = tmp_path / f"soup{ending}"
        soup.export(path)
        back = read_garment(path)
        assert back.vertices.shape == garment.vertices.shape, ending
        assert len(boundary_loops(back.faces)) == 2
        normals = np.cross(*np.diff(back.vertices[back.faces], axis=1).swapaxes(0, 1))
        middle = back.vertices[back.faces].mean(axis=1) * [1, 1, 0]
        assert ((normals * middle).sum(axis=1) > 0).all()


def test_a_mobius_band_has_no_outside(tmp_path):
    count = 12
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    rows = []
    for side in (-0.3, 0.3):
        radius = 1 + side * np.cos(angle / 2)
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        rows.append(np.column_stack([x, y, side * np.sin(angle / 2)]))
    a, b = np.arange(count), np.arange(count) + count
    c, d = np.append(a[1:], b[0]), np.append(b[1:], a[0])
    faces = np.concatenate([np.stack([a, c, d], 1), np.stack([a, d, b], 1)])
    trimesh.Trimesh(np.concatenate(rows), faces, process=False).export(
        tmp_path / "band.ply"
    )
    with pytest.raises(HeadError, match="a band with a twist has no outside"):
        read_garment(tmp_path / "band.ply")


def test_several_meshes_of_a_scene_are_one_garment(tmp_path):
    mesh = trimesh.Trimesh(*tube(), process=False)
    scene = trimesh.Scene([mesh])
    scene.add_geometry(
        mesh, transform=trimesh.transformations.translation_matrix([4, 0, 0])
    )
    scene.export(tmp_path / "two.glb")
    garment = read_garment(tmp_path / "two.glb")
    assert len(garment.vertices) == 64
    assert garment.vertices[:, 0].max() == pytest.approx(5)


def test_the_highest_opening_is_pinned(garment):
    loops = boundary_loops(garment.faces)
    assert sorted(map(len, loops)) == [8, 8]
    assert sorted(np.concatenate(loops)) == [*range(8), *range(24, 32)]
    free = Garment.create(garment.vertices, garment.faces, name="tube")
    assert same(pin_boundary(free), garment) and pin_boundary(free).name == "tube"
    assert pin_boundary(free, above=1.5).pinned.sum() == 16
    with pytest.raises(HeadError, match="no vertex is above 9 m, the highest is at 3"):
        pin_boundary(free, above=9)


def test_a_loop_goes_round():
    loop = boundary_loops(tube()[1])[0] % 8
    assert set((loop - np.roll(loop, 1)) % 8) in ({1}, {7})


def test_files_that_are_no_garment(tmp_path, garment):
    with pytest.raises(HeadError, match="no such file"):
        read_garment(tmp_path / "none.npz")
    for name, content in {
        "text.npz": b"no archive",
        "text.glb": b"no glTF",
        "text.ply": b"ply\nformat",
        "empty.obj": b"v 0 0 0\n",
    }.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(HeadError, match=rf"{name}: file: it"):
            read_garment(tmp_path / name)
    with pytest.raises(HeadError, match=r"ends in '.fbx'"):
        read_garment(tmp_path / "shirt.fbx")
    with pytest.raises(HeadError, match=r"ends in '.stl'"):
        write_garment(tmp_path / "shirt.stl", garment)
    with pytest.raises(HeadError, match="cannot be written"):
        write_garment(tmp_path / "no folder" / "shirt.npz", garment)


def test_a_pickle_is_not_opened(tmp_path):
    vertices, faces = tube()
    np.savez(tmp_path / "p.npz", vertices=vertices.astype(object), faces=faces)
    with pytest.raises(HeadError, match="cannot be read"):
        read_garment(tmp_path / "p.npz")


def test_a_file_that_lacks_a_field(tmp_path):
    np.savez(tmp_path / "v.npz", vertices=tube()[0])
    with pytest.raises(HeadError, match=r"cannot be read.*save vertices and faces"):
        read_garment(tmp_path / "v.npz")
