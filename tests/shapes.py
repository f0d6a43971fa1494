"""Small heads that the tests share."""

import numpy as np
import trimesh

from skinlib import Head, Skeleton


def skeleton(bones: int = 5, seed: int = 0) -> Skeleton:
    """A random tree of bones inside the unit ball, parents in any order."""
    rng = np.random.default_rng(seed)
    parents = [-1] + [int(rng.integers(bone)) for bone in range(1, bones)]
    tree = Skeleton.from_heads_and_tails(
        rng.uniform(-0.6, 0.6, (bones, 3)),
        None,
        parents,
        [f"bone_{bone}" for bone in range(bones)],
    )
    return tree.reordered(rng.permutation(bones))


def sphere(subdivisions: int = 2, bones: int = 5, **options) -> Head:
    """A unit sphere of 12, 42, 162, 642, 2562, ... vertices."""
    ball = trimesh.creation.icosphere(subdivisions)
    return Head.create(ball.vertices, ball.faces, skeleton(bones), **options)


def bumpy(head: Head, part: float = 1e-3) -> Head:
    """The head without the ties between distances that a perfect symmetry brings."""
    centre, rng = head.vertices.mean(axis=0), np.random.default_rng(0)
    noise = rng.normal(1, part, head.vertices.shape)
    return head.replace(vertices=centre + (head.vertices - centre) * noise)


def unwelded(head: Head) -> tuple[Head, np.ndarray]:
    """The head with three vertices of its own per face, and their old ids."""
    old = head.faces.ravel()
    faces = np.arange(len(old)).reshape(-1, 3)
    weights = None if head.weights is None else head.weights[old]
    apart = Head.create(
        head.vertices[old], faces, head.skeleton, weights, normals=head.normals[old]
    )
    return apart, old


def axis_rotations() -> list[np.ndarray]:
    """The 24 rotations that map axes onto axes."""
    turns = []
    for i in range(3):
        for j in {0, 1, 2} - {i}:
            for a in (1, -1):
                for b in (1, -1):
                    rows = np.zeros((3, 3))
                    rows[0, i], rows[1, j] = a, b
                    rows[2] = np.cross(rows[0], rows[1])
                    turns.append(rows)
    return turns


def moved(head: Head, rotation=None, scale: float = 1.0, shift=(0, 0, 0)) -> Head:
    """The head with mesh and skeleton rotated, scaled and shifted."""
    rotation = np.eye(3) if rotation is None else rotation

    def place(points):
        return points.astype(np.float64) @ rotation.T * scale + shift

    bones = head.skeleton
    return Head.create(
        place(head.vertices),
        head.faces,
        Skeleton.from_heads_and_tails(
            place(bones.joints), place(bones.tails), bones.parents, bones.names
        ),
        head.weights,
        normals=head.normals @ rotation.T,
        name=head.name,
    )


def mirrored_square():
    """Two vertices left, two right, two in the middle; a bone on each side."""
    skeleton = Skeleton.from_heads_and_tails(
        [[0, 0, 0], [1, 1, 0], [-1, 1, 0]], None, [-1, 0, 0], ["head", "a", "b"]
    )
    vertices = [[1, 0, 0], [0, 0, 0], [-1, 0, 0], [1, 1, 0], [0, 1, 0], [-1, 1, 0]]
    faces = [[0, 3, 1], [3, 4, 1], [1, 4, 2], [4, 5, 2]]
    return Head.create(vertices, faces, skeleton)
