"""From a body to what it wears: does a garment fit, and which bones move its vertices.

A garment vertex starts with the weights of the body point closest to it. Smoothed along
the cloth they no longer tear where neighbours are closest to different limbs, as in a
skirt between the legs: Bertiche, Madadi and Escalera, PBNS, TOG 2021, and Neural Cloth
Simulation, TOG 2022.
"""

import numpy as np
from scipy.sparse import coo_matrix
from trimesh.triangles import points_to_barycentric

from skinlib.garments.garment import Garment
from skinlib.geometry import face_normals, mesh_edges
from skinlib.head import Head, HeadError

FAR = 0.3  # metres: no garment hangs further from the skin, in the median
SMALLEST = 0.02  # of the body's longest side: nothing that is worn is smaller
MOST_INSIDE = 0.2  # share of a garment's vertices that may begin inside the body
MOST_THROUGH = 0.01  # and of an outer layer's that may begin inside the inner one


def closest_point_weights(garment: Garment, head: Head) -> np.ndarray:
    """(V, J) float32 weights of the body at the point closest to each garment vertex.

    Rows sum to 1.

    Raises:
        HeadError: the body has no weights.
    """
    if head.weights is None:
        raise HeadError("weights", "the body has none", "skin it first")
    weights = closest_point_values(garment.vertices, head, head.weights)
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


def closest_point_values(
    points: np.ndarray, head: Head, values: np.ndarray
) -> np.ndarray:
    """(N, C) float64: what a body has at the surface point closest to each point.

    Args:
        points: (N, 3). values: (V, C) at the vertices of the body, linear in between.
    """
    import igl  # here, since it takes long to load

    body = head.vertices.astype(np.float64)
    _, face, closest = igl.point_mesh_squared_distance(
        points.astype(np.float64), body, head.faces
    )
    corners = head.faces[face]
    # A triangle without area has no such coordinates: take its first corner.
    with np.errstate(invalid="ignore", divide="ignore"):
        share = points_to_barycentric(body[corners], closest, method="cross")
    share = np.where(np.isfinite(share).all(axis=1, keepdims=True), share, [1, 0, 0])
    return np.einsum("vc,vcj->vj", np.clip(share, 0, None), values[corners])


def smooth(weights: np.ndarray, faces: np.ndarray, iterations: int) -> np.ndarray:
    """(V, J) float32: each row replaced by the mean of its neighbours', repeatedly.

    W <- L^k W, L the row-normalised adjacency: 10 times for tight clothes, 50 to 100
    for a skirt. Rows go on summing to 1.

    Args:
        weights: (V, J).
        faces: (F, 3).
        iterations: k, 0 or more.

    Raises:
        HeadError: a negative number of iterations.

    >>> smooth(np.array([[1.0, 0], [1, 0], [0, 1]]), np.array([[0, 1, 2]]), 1).tolist()
    [[0.5, 0.5], [0.5, 0.5], [1.0, 0.0]]
    """
    if iterations < 0:
        raise HeadError("iterations", f"there are {iterations}", "give 0 or more")
    edges, size = mesh_edges(faces), len(weights)
    a, b = np.concatenate([edges, edges[:, ::-1]]).T
    alone = np.setdiff1d(np.arange(size), a)  # a vertex of no face keeps its weights
    a, b = np.concatenate([a, alone]), np.concatenate([b, alone])
    degree = np.bincount(a, minlength=size)
    mean = coo_matrix((1 / degree[a], (a, b)), (size, size)).tocsr()
    weights = np.asarray(weights, np.float64)
    for _ in range(iterations):
        weights = mean @ weights
    return weights.astype(np.float32)


def check_fit(garment: Garment, head: Head) -> np.ndarray:
    """(V,) float64 metres from the skin to each vertex, negative inside the body.

    Raises:
        HeadError: the garment is far from the body or tiny, as one in other units, axes
            or at another place is; more than a fifth of it is inside the body; or it
            shows the body its outside.
    """
    import igl  # here, since it takes long to load

    body = head.vertices
    distance = signed_distance(garment.vertices, body, head.faces)
    median = float(np.median(np.abs(distance)))
    low, high = garment.vertices.min(axis=0), garment.vertices.max(axis=0)
    apart = ((low > body.max(axis=0)) | (high < body.min(axis=0))).any()
    if median > FAR or apart:
        raise HeadError(
            "vertices",
            f"half of the garment is {median:.3g} m or more away from the body; it "
            f"measures {_size(garment.vertices)} round {_middle(garment.vertices)}, "
            f"the body {_size(body)} round {_middle(body)}",
            "check scale, axes and position: metres, Z up, on the body at rest",
        )
    if np.ptp(garment.vertices, axis=0).max() < SMALLEST * np.ptp(body, axis=0).max():
        raise HeadError(
            "vertices",
            f"the garment measures {_size(garment.vertices)}, the body {_size(body)}",
            "check its scale: metres, on the body at rest",
        )
    inside = float((distance < 0).mean())
    if inside > MOST_INSIDE:
        raise HeadError(
            "vertices",
            f"{inside:.0%} of the garment's vertices lie inside the body, the deepest "
            f"{-distance.min() * 1000:.0f} mm",
            "put it on in the body's rest pose, or push it out along the normals",
        )
    normals = face_normals(garment.vertices, garment.faces)  # twice the area long
    middles = garment.vertices[garment.faces].mean(axis=1).astype(np.float64)
    _, skin, _ = igl.point_mesh_squared_distance(
        middles, body.astype(np.float64), head.faces
    )
    away = (normals * face_normals(body, head.faces)[skin]).sum(axis=1) < 0
    areas = np.linalg.norm(normals, axis=1)
    share = float(areas[away].sum() / areas.sum())
    if share > 0.5:
        name = garment.name or "the garment"
        raise HeadError(
            "faces",
            f"{share:.0%} of {name} shows its outside to the skin",
            "turn its faces round (flip the normals)",
        )
    return distance


def layers_apart(inner: Garment, outer: Garment) -> int:
    """How many vertices of an outer layer begin inside an inner one; up to 1 % may.

    A vertex is inside when the closest point of the inner layer, away from its hems,
    has it behind.

    Raises:
        HeadError: more of them do.
    """
    points = outer.vertices
    through = behind(points, inner.vertices, inner.faces)
    if through.mean() > MOST_THROUGH:
        first = int(np.flatnonzero(through)[0])
        raise HeadError(
            "layers",
            f"{through.sum()} of {len(through)} vertices of {outer.name or 'the outer'}"
            f" lie inside {inner.name or 'the inner one'}, the first is vertex {first}",
            "name the layers from the skin outwards, and pull the outer one off the "
            "inner",
        )
    return int(through.sum())


def signed_distance(
    points: np.ndarray, vertices: np.ndarray, faces: np.ndarray
) -> np.ndarray:
    """(N,) metres from points to a closed surface, negative inside.

    Inside is where the surface winds round a point, also where it runs through itself.
    """
    import igl

    points, vertices = points.astype(np.float64), vertices.astype(np.float64)
    # Not `igl.signed_distance`: it multiplies by how often the surface winds round.
    squared, _, _ = igl.point_mesh_squared_distance(points, vertices, faces)
    inside = igl.fast_winding_number(vertices, faces, points) > 0.5
    return np.where(inside, -1, 1) * np.sqrt(squared)


def behind(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(N,) bool: points behind the closest point of an open mesh, unless on its hem."""
    import igl

    points = points.astype(np.float64)
    kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    distance, face, closest, _ = igl.signed_distance(
        points, vertices.astype(np.float64), faces, kind
    )
    sides = np.sort(faces[:, [1, 2, 2, 0, 0, 1]].reshape(-1, 2), axis=1)
    _, edge, uses = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    border = np.unique(sides[uses[edge.ravel()] == 1])
    corners = faces[face]
    with np.errstate(invalid="ignore", divide="ignore"):
        share = points_to_barycentric(vertices[corners], closest, "cross")
    on_hem = np.where(np.isin(corners, border), share, 0).sum(axis=1) > 1 - 1e-6
    return (distance < 0) & ~on_hem


def _size(points: np.ndarray) -> str:
    return " x ".join(f"{x:.3g}" for x in np.ptp(points, axis=0)) + " m"


def _middle(points: np.ndarray) -> str:
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    return "(" + ", ".join(f"{x:.2f}" for x in middle) + ")"
