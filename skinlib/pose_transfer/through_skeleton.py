"""Pose transfer through a skeleton: fit its bones to the source, turn the target's.

The peer of the networks that a rig makes possible. What it is given, besides the two
meshes, decides how fair the comparison is; from much to little:

1. The source's rest pose with weights, and the posed vertices in its order: `fit_pose`.
2. A body with shapes on the same mesh, but not who the source is: `fit_pose` finds the
   shape and the scale besides, and `transfer` needs no rest pose of either mesh.
3. A body and a cloud of points, as the networks are given: `fit_cloud`.

With G_k the rotation of bone k in world axes, s the scale, c_k its joint, p_v a vertex
at rest, w_vj its weights and W_vm those of bone m and all below it, a skinned vertex is
linear in the rotations:

    x_v = s (y + sum_k G_k a_vk),  a_vk = w_vk (p_v - c_k) + sum_m W_vm (c_m - c_k)

over the children m of k; y is where the root's joint goes. Joints stay connected
whatever the rotations are, and p and c are linear in the shape. Least squares by
Levenberg and Marquardt, from a Procrustes rotation of each bone (Kabsch 1976).

Symbols: V vertices of the body, J bones, K shapes, P points of a cloud.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from skinlib.garments.body import Body
from skinlib.garments.motion import Motion
from skinlib.geometry import row_dot
from skinlib.head import Head, HeadError, Skeleton
from skinlib.pose_transfer.metrics import checked_points
from skinlib.skinning import descendants, forward_kinematics, linear_blend_skinning

ITERATIONS = 60
STARTS = 8
# How strongly joints are held in the pose they start from, and shapes in their mean,
# while a cloud is matched: for a radian, and for 1 of a shape, relative to the body.
STIFFEST, LOOSEST = 1e-1, 1e-5
PROBES = 500  # points of a cloud that tell which poses to start from


class Fit(NamedTuple):
    """A pose, and the shape and scale in which it was found.

    Attributes:
        rotations: (J, 3, 3) float64 for `forward_kinematics`.
        translation: (3,) how far the root's joint moves, in the body's unit.
        scale: from the body's unit to that of the points; 1 when not asked for.
        amounts: (K,) of the body's shapes; 0 when not asked for.
        error: root of the mean squared distance left, in the body's unit.
    """

    rotations: np.ndarray
    translation: np.ndarray
    scale: float
    amounts: np.ndarray
    error: float


def fit_pose(
    body: Body | Head,
    points: np.ndarray,
    scaled: bool = False,
    shaped: bool = False,
    iterations: int = ITERATIONS,
) -> Fit:
    """The rotations that bring a skinned body closest to posed points in its order.

    Args:
        body: at rest, with weights. points: (V, 3), vertex by vertex.
        scaled: whether the points are in an unknown unit, as normalised ones are.
        shaped: whether they are of an unknown shape, of those the body has.
        iterations: at most; it stops when nothing changes any more.

    Raises:
        HeadError: no weights, several roots, another number of points, NaN, all points
            at one place, or `shaped` with a body without shapes.
    """
    model = _Model.of(body, shaped)
    points = _checked(points)
    if len(points) != model.size:
        raise HeadError(
            "points",
            f"{len(points)} of them for a body of {model.size} vertices",
            "give them in the order of the body, or use fit_cloud",
        )
    state = model.procrustes(points, scaled)
    weights = np.ones(len(points))
    return model.fit(
        *model.solve(state, points, weights, scaled, iterations=iterations)
    )


def fit_cloud(
    body: Body | Head,
    points: np.ndarray,
    scaled: bool = False,
    shaped: bool = False,
    poses: Motion | None = None,
    starts: int = STARTS,
    rounds: int = 60,
) -> Fit:
    """The pose, closest to a cloud of points in no order, that was found: by ICP.

    Vertices and points are matched with the nearest of the other kind, both ways, and
    the pose is fitted to the matches, in turn, while what holds the joints in place
    gives way. It ends in the nearest hollow: poses far from where it starts are not
    found. Known poses, such as those that a network was trained on, give it more places
    to start from. A body of a few hundred vertices is enough and takes a second or two,
    one of 12,000 minutes.

    Args:
        body, scaled, shaped: as for `fit_pose`.
        points: (P, 3), spread over the surface, upright as the body is.
        poses: of the body's bones, to start from besides the rest pose.
        starts: so many of these, the closest to the cloud, are followed; 1 or more.
        rounds: of matching, 1 or more.

    Raises:
        HeadError: as `fit_pose`, no start or round, or poses of other bones.
    """
    if min(rounds, starts) < 1:
        raise HeadError(
            "starts", f"{starts} with {rounds} rounds", "ask for 1 or more of each"
        )
    model = _Model.of(body, shaped)
    points = _checked(points)
    tree = cKDTree(points)
    stiff = np.geomspace(STIFFEST, LOOSEST, rounds)
    begun = model.starts(points, scaled, poses)
    if len(begun) > starts:
        rng = np.random.default_rng(0)
        few = rng.permutation(len(points))[:PROBES]
        some = rng.permutation(model.size)[:PROBES]
        apart = [_misfit(model.posed(state)[some], points[few]) for state in begun]
        begun = [begun[i] for i in np.argsort(apart, kind="stable")[:starts]]
    ends = []
    for state in begun:
        local = model._local(state.turns)
        for stiffness in stiff:
            targets, weights = _matched(model.posed(state), points, tree)
            state, _ = model.solve(
                state, targets, weights, scaled, stiffness, local, iterations=2
            )
        ends.append(state)
    best = min(ends, key=lambda state: _misfit(model.posed(state), points))
    squared = tree.query(model.posed(best))[0] ** 2
    return model.fit(best, float(np.sqrt(squared.mean())) / best.scale)


def _matched(
    posed: np.ndarray, points: np.ndarray, tree: cKDTree
) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) the mean point that each vertex is matched with, and (V,) their weight."""
    back = cKDTree(posed).query(points)[1]
    share, size = len(posed) / len(points), len(posed)
    weights = 1 + share * np.bincount(back, minlength=size)
    sums = [np.bincount(back, x, size) for x in points.T]
    targets = points[tree.query(posed)[1]] + share * np.stack(sums, axis=1)
    return targets / weights[:, None], weights


def _misfit(posed: np.ndarray, points: np.ndarray) -> float:
    """Mean squared distance to the nearest one, both ways."""
    there, back = cKDTree(points).query(posed)[0], cKDTree(posed).query(points)[0]
    return float((there**2).mean() + (back**2).mean())


def apply_pose(fit: Fit, target: Head) -> np.ndarray:
    """(N, 3) float32: a skinned target at rest in the pose of a fit; its root stays.

    Raises:
        HeadError: it has no weights, or another number of bones.
    """
    if target.weights is None:
        raise HeadError("weights", "the target has none", "skin it first")
    if len(target.skeleton) != len(fit.rotations):
        raise HeadError(
            "bone_names",
            f"the target has {len(target.skeleton)} bones, the pose is one of "
            f"{len(fit.rotations)}",
            "use a target with the bones of the body that was fitted",
        )
    transforms = forward_kinematics(target.skeleton, fit.rotations)
    posed = linear_blend_skinning(target.vertices, target.weights, transforms)
    return posed.astype(np.float32)


def at_rest(fit: Fit, body: Body, points: np.ndarray) -> Head:
    """The body whose posed vertices were fitted, back in the rest pose.

    Each vertex goes the way back of its blended transform, so that what the body's
    shapes cannot express is kept. Joints are those of the fitted shape.

    Args:
        points: (V, 3) as given to `fit_pose`, in the body's order.

    Raises:
        HeadError: another number of points.
    """
    head = body.head
    points = _checked(points)
    if points.shape != head.vertices.shape:
        raise HeadError(
            "points",
            f"{len(points)} of them for a body of {len(head.vertices)} vertices",
            "give those that were fitted",
        )
    skeleton = _shaped_skeleton(body, fit.amounts)
    moved = np.zeros((len(skeleton), 3))
    moved[skeleton.parents < 0] = fit.translation
    transforms = forward_kinematics(skeleton, fit.rotations, moved)
    blended = np.einsum("vj,jxy->vxy", head.weights, transforms)
    offset = points / fit.scale - blended[:, :3, 3]
    # Where bones turned against each other cancel out there is no way back.
    rest = (np.linalg.pinv(blended[:, :3, :3], rcond=1e-3) @ offset[..., None])[..., 0]
    return Head.create(rest, head.faces, skeleton, weights=head.weights)


def transfer(
    body: Body, source: np.ndarray, identity: np.ndarray, scaled: bool = True
) -> np.ndarray:
    """(V, 3) float32: the identity in the source's pose, in the body's unit.

    Both are meshes in the body's vertex order, posed, of unknown shape, and where
    `scaled` each in a unit of its own. Pose and shape of both are fitted, the identity
    is brought back to rest, and turned as the source is.

    Raises:
        HeadError: as `fit_pose`.
    """
    shaped = bool(body.shape_names)
    pose = fit_pose(body, source, scaled, shaped)
    own = fit_pose(body, identity, scaled, shaped)
    return apply_pose(pose, at_rest(own, body, identity))


# --- least squares ------------------------------------------------------------------


class _State(NamedTuple):
    """What is fitted: (J, 3, 3) world rotations, s y, s and (K,) amounts."""

    turns: np.ndarray
    root: np.ndarray
    scale: float
    amounts: np.ndarray


@dataclass(frozen=True, eq=False)
class _Model:
    """A body as sums of rotated arms.

    Attributes:
        skeleton: of the mean shape.
        rest: (V, 3). weights: (V, J).
        arms: (J, V, 3) a_vk. shape_arms: (K, J, V, 3), what each shape adds.
    """

    body: Body
    skeleton: Skeleton
    rest: np.ndarray
    weights: np.ndarray
    arms: np.ndarray
    shape_arms: np.ndarray

    @classmethod
    def of(cls, body: Body | Head, shaped: bool) -> "_Model":
        if isinstance(body, Head):
            none = np.zeros((0, 1, 3), np.float32)
            body = Body(body, (), none, none)
        head = body.head
        if head.weights is None:
            raise HeadError("weights", "the body has none", "skin it first")
        skeleton = head.skeleton
        if (skeleton.parents < 0).sum() != 1:
            raise HeadError(
                "bone_parents", "there are several roots", "hang all bones on one"
            )
        if shaped and not body.shape_names:
            raise HeadError(
                "shapes", "the body has none", "fit without, or use a body with shapes"
            )
        weights = head.weights.astype(np.float64)
        below = np.stack(
            [
                weights[:, descendants(skeleton, [bone])].sum(axis=1)
                for bone in range(len(skeleton))
            ]
        )  # (J, V)

        def arms(vertices: np.ndarray, joints: np.ndarray) -> np.ndarray:
            vertices, joints = (np.asarray(x, np.float64) for x in (vertices, joints))
            result = weights.T[..., None] * (vertices - joints[:, None])
            for bone, parent in enumerate(skeleton.parents.tolist()):
                if parent >= 0:
                    result[parent] += below[bone][:, None] * (
                        joints[bone] - joints[parent]
                    )
            return result

        shapes = zip(body.shape_vertices, body.shape_joints, strict=True)
        shape_arms = [arms(*shape) for shape in shapes] if shaped else []
        return cls(
            body,
            skeleton,
            head.vertices.astype(np.float64),
            weights,
            arms(head.vertices, skeleton.joints),
            np.array(shape_arms).reshape(-1, *weights.T.shape, 3),
        )

    @property
    def size(self) -> int:
        return len(self.rest)

    def arms_of(self, amounts: np.ndarray) -> np.ndarray:
        return self.arms + np.tensordot(amounts, self.shape_arms, 1)

    def posed(self, state: _State) -> np.ndarray:
        turned = self.arms_of(state.amounts) @ state.turns.transpose(0, 2, 1)
        return state.root + state.scale * turned.sum(axis=0)

    def placed(self, pose: np.ndarray, points: np.ndarray, scaled: bool) -> _State:
        """The body in a pose of local rotations, in the points' box."""
        turns = np.array(pose)
        for bone in self.skeleton.order.tolist():
            parent = self.skeleton.parents[bone]
            if parent >= 0:
                turns[bone] = turns[parent] @ turns[bone]
        state = _State(turns, np.zeros(3), 1.0, np.zeros(len(self.shape_arms)))
        posed = self.posed(state)
        scale = 1.0
        if scaled:
            scale = float(np.ptp(points, axis=0).max() / np.ptp(posed, axis=0).max())
        low, high = points.min(axis=0), points.max(axis=0)
        middle = scale * (posed.min(axis=0) + posed.max(axis=0)) / 2
        return state._replace(root=(low + high) / 2 - middle, scale=scale)

    def starts(
        self, points: np.ndarray, scaled: bool, poses: Motion | None
    ) -> list[_State]:
        """The rest pose and the others, each in the points' box."""
        still = np.broadcast_to(np.eye(3), (len(self.skeleton), 3, 3))
        local = [still]
        if poses is not None:
            poses.transforms(self.skeleton)  # are they poses of these bones?
            local += list(poses.matrices().astype(np.float64))
        return [self.placed(pose, points, scaled) for pose in local]

    def procrustes(self, points: np.ndarray, scaled: bool) -> _State:
        """Each bone turned by itself, as the vertices it moves have turned."""
        share = np.concatenate([self.weights, np.ones((self.size, 1))], axis=1).T
        total = np.maximum(share.sum(axis=1), 1e-12)[:, None]
        before, after = share @ self.rest / total, share @ points / total  # (J + 1, 3)
        # Of sums, not of differences, which would be a copy of the mesh for each bone.
        mixed = np.einsum("jv,vx,vy->jxy", share, points, self.rest, optimize=True)
        mixed -= total[..., None] * after[:, :, None] * before[:, None]
        left, size, right = np.linalg.svd(mixed)
        flip = np.sign(np.linalg.det(left @ right))
        left[:, :, 2] *= flip[:, None]
        turns = left @ right
        spread = share @ row_dot(self.rest, self.rest)
        spread -= total[:, 0] * row_dot(before, before)
        known = size[:, 1] > 1e-3 * size[:, 0]
        known &= spread > 1e-6 * spread[-1]
        for bone in self.skeleton.order.tolist():
            if not known[bone]:
                turns[bone] = turns[self.skeleton.parents[bone]]  # -1: the whole body
        scale = 1.0
        if scaled:
            size[:, 2] *= flip
            scale = float(size[:-1].sum() / spread[:-1].sum())
        state = _State(turns[:-1], np.zeros(3), scale, np.zeros(len(self.shape_arms)))
        root = (points - self.posed(state)).mean(axis=0)
        return state._replace(root=root)

    def solve(
        self,
        state: _State,
        targets: np.ndarray,
        weights: np.ndarray,
        scaled: bool,
        stiffness: float = 0.0,
        local: np.ndarray | None = None,
        iterations: int = ITERATIONS,
    ) -> tuple[_State, float]:
        """Levenberg-Marquardt steps; the state, and the root mean square that is left.

        Args:
            targets: (V, 3). weights: (V,) of the vertices.
            stiffness: how strongly bones are held to their parents and shapes to 0; see
                `STIFFEST`.
            local: (J, 3, 3) in which rotation to its parent each bone is held.
        """
        if local is None:
            local = np.broadcast_to(np.eye(3), state.turns.shape)
        hold = stiffness * np.ptp(self.rest, axis=0).max() ** 2 * weights.sum()

        def cost(state: _State) -> float:
            offset = (targets - self.posed(state)) / state.scale
            bent = self._bent(state.turns, local)
            held = (bent**2).sum() + (state.amounts**2).sum()
            return float(weights @ row_dot(offset, offset) + hold * held)

        now, damping = cost(state), 1e-4
        for _ in range(iterations):
            matrix, slope = self._normal(state, targets, weights, scaled, hold, local)
            diagonal = np.diag(matrix).copy()
            diagonal += 1e-9 * diagonal.max()
            better = None
            while better is None and damping < 1e8:
                step = np.linalg.solve(matrix + np.diag(damping * diagonal), slope)
                trial = self._moved(state, step)
                after = cost(trial) if trial.scale > 0 else np.inf
                if after < now:
                    better = trial
                    damping = max(damping / 10, 1e-12)
                else:
                    damping *= 10
            if better is None:
                break
            state, gain, now = better, now - after, after
            if gain <= 1e-10 * now or now == 0:
                break
        offset = targets - self.posed(state)
        squared = weights @ row_dot(offset, offset) / weights.sum()
        return state, float(np.sqrt(squared)) / state.scale

    def _normal(self, state, targets, weights, scaled, hold, local):
        """The normal equations of one step, with lengths in the body's unit."""
        bones, count = len(self.skeleton), self.size
        arms = self.arms_of(state.amounts) @ state.turns.transpose(0, 2, 1)
        shapes = np.einsum("kjvx,jyx->kvy", self.shape_arms, state.turns, optimize=True)
        total = arms.sum(axis=0)
        columns = np.zeros((count, 3, 3 * bones + 3 + len(shapes) + scaled))
        # d x G a: of each axis d, over the three coordinates.
        for axis, (up, down) in enumerate(((1, 2), (2, 0), (0, 1))):
            columns[:, down, axis : 3 * bones : 3] = arms[..., up].T
            columns[:, up, axis : 3 * bones : 3] = -arms[..., down].T
        place = 3 * bones
        columns[:, range(3), range(place, place + 3)] = 1
        for number, shape in enumerate(shapes, start=place + 3):
            columns[..., number] = shape
        if scaled:
            columns[..., -1] = total
        offset = (targets - state.root) / state.scale - total
        root = np.sqrt(weights)[:, None, None]
        columns = (root * columns).reshape(3 * count, -1)
        matrix = columns.T @ columns
        slope = columns.T @ (root[..., 0] * offset).reshape(-1)
        if hold:
            tie = np.zeros((bones, bones))
            child = np.flatnonzero(self.skeleton.parents >= 0)
            tie[child, child] = 1
            tie[child, self.skeleton.parents[child]] = -1
            joined = np.kron(tie, np.eye(3))
            matrix[:place, :place] += hold * joined.T @ joined
            slope[:place] -= (
                hold * joined.T @ self._bent(state.turns, local).reshape(-1)
            )
            amounts = range(place + 3, place + 3 + len(shapes))
            matrix[amounts, amounts] += hold
            slope[amounts] -= hold * state.amounts
        return matrix, slope

    def _bent(self, turns: np.ndarray, local: np.ndarray) -> np.ndarray:
        """(J, 3) rotation vectors in world axes, from where each bone is held to it."""
        parents = self.skeleton.parents
        bent = turns @ (turns[parents] @ local).transpose(0, 2, 1)
        bent[parents < 0] = np.eye(3)
        return Rotation.from_matrix(bent).as_rotvec()

    def _local(self, turns: np.ndarray) -> np.ndarray:
        """(J, 3, 3) the rotations of bones in the axes of their parents."""
        parents = self.skeleton.parents
        above = np.where(parents[:, None, None] >= 0, turns[parents], np.eye(3))
        return above.transpose(0, 2, 1) @ turns

    def _moved(self, state: _State, step: np.ndarray) -> _State:
        bones, shapes = len(self.skeleton), len(self.shape_arms)
        turn, step = step[: 3 * bones].reshape(-1, 3), step[3 * bones :]
        shift, amounts, stretch = np.split(step, [3, 3 + shapes])
        scale = state.scale * (1 + float(stretch.sum()))
        return _State(
            Rotation.from_rotvec(turn).as_matrix() @ state.turns,
            state.root + state.scale * shift,
            scale,
            state.amounts + amounts,
        )

    def fit(self, state: _State, error: float) -> Fit:
        parents = self.skeleton.parents
        amounts = np.zeros(len(self.body.shape_names))
        amounts[: len(state.amounts)] = state.amounts
        root = _shaped_skeleton(self.body, amounts).joints[parents < 0][0]
        return Fit(
            self._local(state.turns),
            state.root / state.scale - root,
            state.scale,
            amounts,
            error,
        )


def _shaped_skeleton(body: Body, amounts: np.ndarray) -> Skeleton:
    skeleton = body.head.skeleton
    joints = skeleton.joints.astype(np.float64)
    if len(amounts):
        joints = joints + np.tensordot(amounts, body.shape_joints, 1)
    return Skeleton.from_heads_and_tails(joints, None, skeleton.parents, skeleton.names)


def _checked(points: np.ndarray) -> np.ndarray:
    points = checked_points(points)
    if not np.ptp(points, axis=0).any():
        raise HeadError("points", "all of them are at one place", "give a mesh")
    return points
