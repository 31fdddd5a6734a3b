"""Where to put cameras so that their images hold what others will want to see."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxfx._arguments import check_camera
from jaxfx._checks import WholeNumber, items, whole_number
from jaxfx.camera import Camera
from jaxfx.scene import embree
from jaxfx.scene._scene import Scene
from jaxfx.scene._surface import intersect
from jaxfx.scene._transfer import require_embree
from jaxfx.scene._view import View, check_size


class ViewPlan(NamedTuple):
    """Cameras that together see most: what `plan_views` returns, the most useful first.

    - `cameras`: the chosen ones.
    - `indices`: which of the candidates they are.
    - `covered`: for each, the share of the targets' points, 0 to 1, that it and those before it
      see.
    """

    cameras: tuple[Camera, ...]
    indices: tuple[int, ...]
    covered: tuple[float, ...]


def plan_views(
    scene: Scene,
    targets: Sequence[Camera],
    *,
    candidates: Sequence[Camera] | None = None,
    count: WholeNumber,
    height: WholeNumber,
    width: WholeNumber,
) -> ViewPlan:
    """The few cameras whose images cover most of what other cameras will see.

    Render a cache from each, and `relight.synthesize` has few holes to fill in the targets.

    **Arguments:**

    - `scene`: from `load`, `from_trimesh` or `still_life`.
    - `targets`: the cameras that views are wanted of: a path, say.
    - `candidates`: the cameras to choose from; None chooses from the targets.
    - `count`: how many to choose, at most: where nothing is left to be gained, fewer are.
    - `height`, `width`: size of all images in pixels. Every pixel of a target that shows a
      surface is one point. As many are tested as targets have pixels, from each candidate: for
      a plan, cameras of small images will do.

    **Returns:** a `ViewPlan`.

    **Raises:** `ValueError` for no cameras, a count below 1, or targets that see nothing;
    `RuntimeError` where Embree does not work.

    **Gradient:** none; the host side.

    **Example:** two cameras for a path of five:

    >>> from jaxfx import PinholeCamera, scene
    >>> room, size = scene.still_life(), {"height": 12, "width": 16}
    >>> look = {"at": room.viewpoint.at, "up": [0, 1, 0], "fov_y": 0.8} | size
    >>> path = [PinholeCamera.look_at([x, 0.4, 0.3], **look) for x in (-1.0, -0.5, 0, 0.5, 1)]
    >>> plan = scene.plan_views(room, path, count=2, **size)
    >>> len(plan.cameras), plan.covered[0] < plan.covered[1] <= 1
    (2, True)

    A camera sees a point that lies in its image, of whose face it sees the same side, and
    from which nothing hides it. The one that sees most is taken, then the one that sees most of
    the rest, and so on: at least 63 % of what the best choice of as many would see. Then one is
    exchanged for another as long as that gains, and the order is made again.

    Source: Nemhauser, Wolsey & Fisher 1978, the bound; points and exchanges are our own.
    """
    name = "scene.plan_views"
    if not isinstance(scene, Scene):
        raise ValueError(f"`{name}(scene)` must be a Scene, got {type(scene).__name__}.")
    require_embree("plan_views")
    size = tuple(check_size("plan_views", height, width))
    count = whole_number(f"{name}(count=...)", count)
    targets = _cameras(f"{name}(targets)", targets)
    chosen_from = targets if candidates is None else _cameras(f"{name}(candidates)", candidates)
    points, normals = _points(scene, targets, size)
    if not len(points):
        raise ValueError(f"`{name}(targets)` must see the scene, got nothing in view.")
    seen = np.stack([_sees(scene, camera, points, normals, size) for camera in chosen_from])
    chosen = _exchanged(seen, _greedy(seen, range(len(seen)), count))
    indices = _greedy(seen, chosen, count)
    covered = [float(seen[indices[: n + 1]].any(axis=0).mean()) for n in range(len(indices))]
    return ViewPlan(tuple(chosen_from[i] for i in indices), tuple(indices), tuple(covered))


def _greedy(
    seen: Bool[np.ndarray, "camera point"], among: Sequence[int], count: int
) -> list[int]:
    """Of some cameras, the one that sees most, then the one that sees most of the rest, ..."""
    chosen, left = [], np.ones(seen.shape[1], bool)
    for _ in range(min(count, len(among))):
        best = max(among, key=lambda camera: np.count_nonzero(seen[camera] & left))
        if not (seen[best] & left).any():
            break
        left &= ~seen[best]
        chosen.append(best)
    return chosen


def _exchanged(seen: Bool[np.ndarray, "camera point"], chosen: Sequence[int]) -> list[int]:
    """The choice after every exchange of one camera for another that gains points."""
    chosen, total = list(chosen), np.count_nonzero(seen[list(chosen)].any(axis=0))
    is_better = True
    while is_better:
        is_better = False
        for place in range(len(chosen)):
            rest = seen[chosen[:place] + chosen[place + 1 :]].any(axis=0)
            totals = np.count_nonzero(seen | rest, axis=1)
            if totals.max() > total:
                chosen[place], total, is_better = int(totals.argmax()), totals.max(), True
    return chosen


def _cameras(name: str, values: Any) -> list[Camera]:
    """The cameras of a sequence, of which there is one at least; `ValueError` otherwise."""
    cameras = items(name, values, "a sequence of cameras")
    if not cameras:
        raise ValueError(f"`{name}` must be a sequence of at least one, got none.")
    for camera in cameras:
        check_camera(name, camera)
    return cameras


def _points(
    scene: Scene, cameras: Sequence[Camera], size: tuple[int, ...]
) -> tuple[Float[np.ndarray, "point 3"], Float[np.ndarray, "point 3"]]:
    """The points that the cameras' pixels show, and their faces' normals on the seen side."""
    points, normals = [], []
    for camera in cameras:
        view = View.of(camera, "scene.plan_views")
        hits = intersect(scene, view, embree.first_faces(scene, view, np.zeros(size)))
        origins, directions = (rays.take(hits.pixel, axis=1) for rays in view.rays(*size))
        points.append(view.to_world(origins + hits.depth * directions).T)
        normals.append(view.turn(np.where(hits.front, hits.normal, -hits.normal)).T)
    return np.concatenate(points), np.concatenate(normals)


def _sees(
    scene: Scene,
    camera: Camera,
    points: Float[np.ndarray, "point 3"],
    normals: Float[np.ndarray, "point 3"],
    size: tuple[int, ...],
) -> Bool[np.ndarray, " point"]:
    """Which of the points a camera sees, on the side of their normals."""
    view = View.of(camera, "scene.plan_views")
    local = view.to_camera(points)
    depth = local[2]
    is_before = depth > 0
    shown = local / np.where(is_before, depth, 1) if view.perspective else local
    pixel = view.intrinsics[:2, :2] @ shown[:2] + view.intrinsics[:2, 2:]
    inside = is_before & (pixel >= 0).all(axis=0) & (pixel < [[size[1]], [size[0]]]).all(axis=0)
    eye = np.zeros_like(local)
    if not view.perspective:
        eye[:2] = local[:2]
    to_eye = view.to_world(eye).T - points
    inside &= np.sum(normals * to_eye, axis=1) > 0
    at = np.flatnonzero(inside)
    seen = np.zeros(len(points), bool)
    seen[at] = embree.unobstructed(scene, points[at], points[at] + to_eye[at])
    return seen
