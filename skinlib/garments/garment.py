"""A garment: an open triangle mesh at rest on the body, and the vertices that are held.

Cloth needs a cleaner mesh than a head does: two triangles at most on each edge, all
turned to the same side, and an opening for the body to come out of. Whoever has a
`Garment` may rely on that. Metres and Z up, as the body that wears it.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import ArrayLike
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from skinlib.geometry import face_normals, weld
from skinlib.head import HeadError
from skinlib.io import atomic

PINNED = "_PINNED"
"""The attribute of a `.glb` that marks the vertices which stay on the body."""

MESH_FILES = (".glb", ".gltf", ".obj", ".ply", ".stl")
SMALLEST_AREA = 1e-12  # of a triangle, in squares of the garment's longest side
# A point (x, y, z) of glTF, which is Y up, is (x, -z, y) here.
Z_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])


@dataclass(frozen=True, eq=False)
class Garment:
    """A garment of one or more pieces. Build one with `Garment.create`.

    Attributes:
        vertices: (V, 3) float32, at rest on the body, metres.
        faces: (F, 3) int64, vertex ids; manifold, consistently oriented, open.
        pinned: (V,) bool, the vertices that skinning alone moves, such as a waist.
        name: shown to people, usually the file's stem.
    """

    vertices: np.ndarray
    faces: np.ndarray
    pinned: np.ndarray
    name: str = ""

    @classmethod
    def create(
        cls,
        vertices: ArrayLike,
        faces: ArrayLike,
        pinned: ArrayLike | None = None,
        name: str = "",
        file: str | Path | None = None,
    ) -> "Garment":
        """Check everything and make a `Garment`; nothing is pinned by default.

        Raises:
            HeadError: values that are not finite or ids out of range; fewer than 3
                triangles, or one without an area; an edge of 3 triangles or a vertex
                that two fans share; triangles that face both ways; a closed piece.

        >>> strip = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0]]
        >>> garment = Garment.create(strip, [[0, 1, 2], [2, 1, 3], [2, 3, 4]])
        >>> len(boundary_loops(garment.faces)[0])
        5
        """
        vertices = _checked(vertices, "f", "vertices", file).astype(np.float32)
        if not np.isfinite(vertices).all():
            row = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
            raise HeadError(
                "vertices",
                f"vertex {row} has NaN or infinity",
                "export the garment again with finite values",
                file,
            )
        faces = _checked(faces, "i", "faces", file).astype(np.int64)
        if len(faces) < 3:
            raise HeadError(
                "faces", f"{len(faces)} triangles", "give at least 3 of them", file
            )
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise HeadError(
                "faces",
                f"ids from {faces.min()} to {faces.max()} for {len(vertices)} vertices",
                f"use ids from 0 to {len(vertices) - 1}",
                file,
            )
        _check_cloth(vertices, faces, file)
        pinned = np.zeros(len(vertices), bool) if pinned is None else np.array(pinned)
        if pinned.shape != (len(vertices),) or pinned.dtype != bool:
            raise HeadError(
                "pinned",
                f"{pinned.dtype} values of shape {pinned.shape}",
                f"give a truth value for each of the {len(vertices)} vertices",
                file,
            )
        for array in (vertices, faces, pinned):
            array.flags.writeable = False
        return cls(vertices, faces, pinned, str(name))


def read_garment(path: str | Path) -> Garment:
    """Read a garment from `.npz`, `.glb`, `.gltf`, `.obj`, `.ply` or `.stl`.

    A `.npz` has the fields `vertices`, `faces` and, if any are, `pinned`. In a mesh
    file, vertices at the same position become one, or the cloth would tear along the
    seams of its texture; those of no triangle are left out, and triangles are turned to
    the side that most of the piece faces. glTF is Y up by its standard and is turned to
    Z up. The other formats are taken as they are: export them with Z up.

    A `.glb` or `.gltf` may mark pinned vertices by the attribute `_PINNED`, one number
    a vertex, above 0.5. The other mesh files cannot: see `pin_boundary`.

    Raises:
        HeadError: the file cannot be read, or what it holds is not a garment.
    """
    path = Path(path)
    if path.suffix.lower() not in (".npz", *MESH_FILES):
        raise HeadError(
            "file",
            f"the name ends in {path.suffix!r}",
            f"use one of .npz, {', '.join(MESH_FILES)}",
            path,
        )
    if not path.is_file():
        raise HeadError(
            "file", "there is no such file", "check the name and the folder", path
        )
    is_mesh = path.suffix.lower() != ".npz"
    try:
        vertices, faces, pinned = (_read_mesh if is_mesh else _read_npz)(path)
    except Exception as error:  # whatever a library raises on a malformed file
        raise HeadError(
            "file",
            f"it cannot be read ({type(error).__name__}: {str(error)[:200]})",
            "export it again, or save vertices and faces with numpy.savez_compressed",
            path,
        ) from error
    # What is not finite is told by `create`.
    if is_mesh and len(faces) and np.isfinite(vertices).all():
        vertices, faces, pinned = _mended(vertices, faces, pinned)
    return Garment.create(vertices, faces, pinned, path.stem, path)


def write_garment(path: str | Path, garment: Garment) -> None:
    """Write a garment to `.npz`, `.glb` or `.obj`, whole or not at all.

    A `.glb` is Y up and holds the pins as `_PINNED`; an `.obj` loses them.

    Raises:
        HeadError: another ending, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() == ".npz":
        with atomic(path) as file:
            np.savez_compressed(
                file,
                vertices=garment.vertices,
                faces=garment.faces.astype(np.int32),
                pinned=garment.pinned,
            )
        return
    if path.suffix.lower() not in (".glb", ".obj"):
        raise HeadError(
            "file",
            f"the name ends in {path.suffix!r}",
            "use one of .npz, .glb, .obj",
            path,
        )
    is_glb = path.suffix.lower() == ".glb"
    mesh = trimesh.Trimesh(
        garment.vertices @ Z_UP if is_glb else garment.vertices,
        garment.faces,
        vertex_attributes={PINNED: garment.pinned.astype(np.float32)},
        process=False,
    )
    content = mesh.export(file_type=path.suffix.lower()[1:])
    with atomic(path) as file:
        file.write(content if isinstance(content, bytes) else content.encode())


def boundary_loops(faces: np.ndarray) -> list[np.ndarray]:
    """The openings of a garment: vertex ids in order around each, longest first.

    Args:
        faces: (F, 3) of a manifold mesh.
    """
    import igl  # here, since it takes long to load

    loops = igl.boundary_loop_all(np.asarray(faces, np.int64))
    return sorted((np.array(loop) for loop in loops), key=len, reverse=True)


def pin_boundary(garment: Garment, above: float | None = None) -> Garment:
    """The garment with its highest opening pinned, such as the waist of a skirt.

    Args:
        above: pin instead all vertices higher than this, in metres.

    Raises:
        HeadError: no vertex is that high.

    >>> strip = [[0, 0, 0], [1, 0, 0], [0, 0, 1], [1, 0, 1], [0, 0, 2]]
    >>> garment = Garment.create(strip, [[0, 1, 2], [2, 1, 3], [2, 3, 4]])
    >>> pin_boundary(garment, above=0.5).pinned.tolist()
    [False, False, True, True, True]
    """
    height = garment.vertices[:, 2]
    pinned = np.zeros(len(height), bool)
    if above is None:
        loops = boundary_loops(garment.faces)
        pinned[max(loops, key=lambda loop: height[loop].mean())] = True
    else:
        pinned = height > above
        if not pinned.any():
            raise HeadError(
                "pinned",
                f"no vertex is above {above:g} m, the highest is at {height.max():.3f}",
                "give a lower height",
            )
    return Garment.create(garment.vertices, garment.faces, pinned, garment.name)


def _read_npz(path: Path) -> tuple:
    with np.load(path, allow_pickle=False) as file:
        pinned = file["pinned"] if "pinned" in file else None
        return file["vertices"], file["faces"], pinned


def _read_mesh(path: Path) -> tuple:
    scene = trimesh.load_scene(path, process=False, maintain_order=True)
    meshes = [m for m in scene.dump() if isinstance(m, trimesh.Trimesh)]
    mesh = trimesh.util.concatenate(
        [trimesh.Trimesh(m.vertices, m.faces, process=False) for m in meshes]
    )
    vertices = np.asarray(mesh.vertices, np.float64)
    if path.suffix.lower() in (".glb", ".gltf"):
        vertices = vertices @ Z_UP.T
    pinned = np.concatenate([_pins(mesh) for mesh in meshes])
    return vertices, np.asarray(mesh.faces), pinned


def _mended(vertices, faces, pinned) -> tuple:
    """Welded, without loose vertices, turned to one side.

    A vertex is pinned when one of its copies is.
    """
    place = weld(vertices)
    _, first = np.unique(place, return_index=True)
    held = np.bincount(place, pinned) > 0
    used, faces = np.unique(place[faces], return_inverse=True)
    faces = faces.reshape(-1, 3)
    return vertices[first[used]], _oriented(faces), held[used]


def _pins(mesh: trimesh.Trimesh) -> np.ndarray:
    """(V,) bool: what the mesh's own attribute says."""
    for name, values in mesh.vertex_attributes.items():
        if name.upper() == PINNED and len(values) == len(mesh.vertices):
            return np.asarray(values).reshape(len(values), -1)[:, 0] > 0.5
    return np.zeros(len(mesh.vertices), bool)


def _oriented(faces: np.ndarray) -> np.ndarray:
    """Each piece turned to the side that most of its triangles face, if it can be."""
    import igl

    if not igl.is_edge_manifold(faces)[0]:
        return faces
    turned, piece = igl.bfs_orient(faces)
    same = _turns(turned) == _turns(faces)
    mostly = 2 * np.bincount(piece, same) >= np.bincount(piece)
    return np.where(mostly[piece][:, None], turned, turned[:, ::-1])


def _turns(faces: np.ndarray) -> np.ndarray:
    """(F,) bool: which of the two ways round each triangle names its vertices."""
    a, b, c = faces.T
    return (b > a) ^ (c > b) ^ (a > c)


def _checked(values, kind: str, field: str, file) -> np.ndarray:
    """(N, 3) numbers, integers where `kind` is "i"."""
    array = np.asarray(values)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "iuf":
        found = f"{array.dtype} values of shape {array.shape}"
    elif kind == "i" and array.dtype.kind == "f":
        found = f"{array.dtype} values"
    else:
        return array
    wanted = "integers" if kind == "i" else "numbers"
    raise HeadError(field, found, f"store rows of 3 {wanted}", file)


def _check_cloth(vertices: np.ndarray, faces: np.ndarray, file) -> None:
    """Raise what keeps a mesh from being cloth."""
    import igl

    areas = np.linalg.norm(face_normals(vertices, faces), axis=1) / 2
    flat = np.flatnonzero(areas <= SMALLEST_AREA * np.ptp(vertices, axis=0).max() ** 2)
    if len(flat):
        raise HeadError(
            "faces",
            f"{len(flat)} triangles have no area, the first is triangle {flat[0]}",
            "dissolve degenerate faces",
            file,
        )
    sides = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges, edge, uses = np.unique(
        np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    if (uses > 2).any():
        a, b = edges[uses > 2][0]
        raise HeadError(
            "faces",
            f"{(uses > 2).sum()} edges belong to 3 or more triangles, the first joins "
            f"vertices {a} and {b} at {_place(vertices[a])} and {_place(vertices[b])}",
            "select non-manifold edges and delete the inner faces there",
            file,
        )
    forward = np.bincount(edge.ravel(), sides[:, 0] < sides[:, 1])
    twisted = np.flatnonzero((uses == 2) & (forward != 1))
    if len(twisted):
        a, b = edges[twisted[0]]
        raise HeadError(
            "faces",
            f"triangles face both ways at {len(twisted)} edges, the first joins "
            f"vertices {a} and {b} at {_place(vertices[a])}",
            "recalculate the normals; a band with a twist has no outside: cut it",
            file,
        )
    inner = uses == 2
    _, piece = connected_components(
        coo_matrix((np.ones(len(edges)), tuple(edges.T)), (len(vertices),) * 2), False
    )
    closed = np.setdiff1d(piece[edges[inner]], piece[edges[~inner]])
    if len(closed):
        raise HeadError(
            "faces",
            f"{len(closed)} of {len(np.unique(piece[faces]))} pieces have no open edge",
            "delete the inner layer: a closed surface has no opening for the body",
            file,
        )
    split = ~igl.is_vertex_manifold(faces) & (np.bincount(faces.ravel()) > 0)
    if split.any():
        first = int(split.argmax())
        raise HeadError(
            "faces",
            f"{split.sum()} vertices join parts that share no edge, the first is "
            f"vertex {first} at {_place(vertices[first])}",
            "split the vertex or bridge the gap",
            file,
        )


def _place(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:.3f}" for x in point) + ")"
