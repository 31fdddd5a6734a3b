"""Light from surface to surface: who sees whom, and how much of it gets there.

Points stand for the surfaces that send light back. They are drawn from the mesh, most of them
where a picture gets its light from; each stands for a disc as large as its share of the
surface. The matrix from points to pixels is smooth, and a few of its singular vectors say
nearly all of it. They are found on some of its rows, so that the whole is never in memory.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from jaxfx._arguments import check_camera, check_gbuffer
from jaxfx._checks import as_numpy, whole_number
from jaxfx._sampling import pixel_centers
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.gbuffer import GBuffer
from jaxfx.scene import _embree
from jaxfx.scene._scene import Scene
from jaxfx.scene._surface import Hits, at_hits
from jaxfx.transfer import Transfer


_CANDIDATES = 16  # for each point
_JUDGES = 256  # pixels that say which candidates matter
_ANYWHERE = 0.1  # of the points, where none of those pixels sees them
_ROWS = 4  # pixels for each point that the singular vectors are found on
_BLOCK = 1 << 20  # rays at a time


class _Points(NamedTuple):
    position: Float[np.ndarray, "point 3"]
    normal: Float[np.ndarray, "point 3"]
    diffuse: Float[np.ndarray, "point 3"]
    area: Float[np.ndarray, " point"]


def visible(
    scene: Scene, start: Float[ArrayLike, "*place 3"], end: Float[ArrayLike, "*places 3"]
) -> Bool[Array, "..."]:
    """Whether nothing of the scene stands between two points, by a ray of Embree's.

    Both may lie on surfaces: the last 1e-4 of the scene's scale on either side does not count.

    **Arguments:**

    - `scene`: from `load`, `from_trimesh` or `still_life`.
    - `start`, `end`: world positions; ... 3 each, of shapes that broadcast.

    **Returns:** a bool for each pair.

    **Raises:** `ValueError` for other shapes; `RuntimeError` where Embree does not work.

    **Gradient:** none: this runs on the host, outside every transform.
    """
    _require_embree("visible")
    ends = []
    for name, value in (("start", start), ("end", end)):
        points = as_numpy(f"scene.visible({name})", value)
        if points.shape[-1:] != (3,):
            raise ValueError(
                f"`scene.visible({name})` must have shape (..., 3), got {points.shape}."
            )
        ends.append(points.astype(np.float64))
    one, other = np.broadcast_arrays(*ends)
    seen = _embree.unobstructed(scene, one.reshape(-1, 3), other.reshape(-1, 3))
    return jnp.asarray(seen.reshape(one.shape[:-1]))


def transfer(
    scene: Scene,
    gbuffer: GBuffer,
    camera: PinholeCamera | OrthographicCamera,
    *,
    points: int = 1024,
    rank: int = 64,
    seed: int = 0,
) -> Transfer:
    """How light that surfaces send back, one bounce, reaches each pixel.

    A point of normal M and area A, r away along w, sends a pixel of normal N the share
    `max(N.w, 0) * max(-M.w, 0) * A / (pi * r**2 + A)` of what it sends back, if they see each
    other. The matrix of these is kept as its first `rank` singular vectors. It takes up to
    height * width * `points` rays, some 2 million a second; lights come later.

    **Arguments:**

    - `scene`: what the cache was made from.
    - `gbuffer`, `camera`: the cache, height width, and its camera.
    - `points`: how many stand for the surfaces; they send light from their faces' fronts
      (corners counter-clockwise). The error falls as one over the square root of it.
    - `rank`: singular vectors; at most `points`.
    - `seed`: of the points' places.

    **Returns:** the `Transfer`, in float32, for `relight.indirect`.

    **Raises:** `ValueError` for a count out of range or a cache that shows nothing;
    `RuntimeError` where Embree does not work.

    **Gradient:** none: this runs on the host, outside every transform.

    Source: Hasan, Pellacini & Bala 2006, with singular vectors for their wavelets; the disc is
    Wallace, Elmquist & Haines 1989's.
    """
    _require_embree("transfer")
    check_camera("scene.transfer(camera)", camera)
    gbuffer = check_gbuffer("scene.transfer(gbuffer)", gbuffer)
    points = _count("points", points, None)
    rank = _count("rank", rank, points)
    shown = np.isfinite(gbuffer.depth) & (gbuffer.depth > 0) & (gbuffer.shader >= 0)
    shown = np.asarray(shown)
    if not shown.any():
        raise ValueError("`scene.transfer(gbuffer)` must show something, got nothing.")
    height, width = gbuffer.depth.shape
    place = camera.unproject(pixel_centers(height, width, gbuffer.depth.dtype), gbuffer.depth)
    place = np.asarray(place, np.float64)[shown]
    normal = np.asarray(gbuffer.normal, np.float64)[shown]
    rng = np.random.default_rng(seed)

    def some(count):
        chosen = rng.choice(len(place), min(count, len(place)), replace=False)
        return place[chosen], normal[chosen]

    senders = _choose(scene, points, some(_JUDGES), rng)
    gram = sum(rows.T @ rows for rows in _blocks(scene, *some(_ROWS * points), senders))
    send = np.linalg.eigh(gram)[1][:, ::-1][:, :rank].T
    receive = np.zeros((height, width, rank), np.float32)
    blocks = _blocks(scene, place, normal, senders)
    receive[shown] = np.concatenate([rows @ send.T for rows in blocks])
    kept = (send, senders.position, senders.normal, senders.diffuse)
    return Transfer(receive, *(np.asarray(each, np.float32) for each in kept))


def _choose(
    scene: Scene,
    count: int,
    judges: tuple[Float[np.ndarray, "pixel 3"], Float[np.ndarray, "pixel 3"]],
    rng: np.random.Generator,
) -> _Points:
    """Points of the surface, the denser the more light they send to `judges`."""
    many = _scatter(scene, _CANDIDATES * count, rng)
    small = many._replace(area=many.area / 1e6)  # of no size: what matters is what they send
    matters = np.concatenate([*_blocks(scene, *judges, small)]).mean(axis=0)
    matters = matters / max(matters.mean(), np.finfo(float).tiny) + _ANYWHERE
    chosen = _systematic(matters, count, rng)
    area = many.area[chosen] * (matters.sum() / count / matters[chosen])
    return _Points(many.position[chosen], many.normal[chosen], many.diffuse[chosen], area)


def _scatter(scene: Scene, count: int, rng: np.random.Generator) -> _Points:
    """Points evenly on the surface, and what is there."""
    a, b, c = scene.vertices[scene.faces].transpose(1, 0, 2)
    across = np.cross(b - a, c - a)
    twice = np.linalg.norm(across, axis=1)
    face = _systematic(twice, count, rng)
    root, along = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1 - root, root * (1 - along), root * along])
    flat = (across[face] / twice[face, None]).T
    hits = Hits(np.arange(count), face, np.ones(count), weights, flat, -flat)
    normal, color, metallic = at_hits(scene, hits)
    position = np.einsum("in,nik->nk", weights, scene.vertices[scene.faces[face]])
    area = np.full(count, twice.sum() / 2 / count)
    return _Points(position, normal, color * (1 - metallic)[:, None], area)


def _systematic(
    weights: Float[np.ndarray, " item"], count: int, rng: np.random.Generator
) -> np.ndarray:
    """`count` indices, each about as often as its weight asks for."""
    steps = (np.arange(count) + rng.random()) / count
    total = np.cumsum(weights)
    return np.minimum(np.searchsorted(total, steps * total[-1]), len(weights) - 1)


def _blocks(
    scene: Scene,
    place: Float[np.ndarray, "pixel 3"],
    normal: Float[np.ndarray, "pixel 3"],
    points: _Points,
) -> Iterator[Float[np.ndarray, "rows point"]]:
    """The matrix from points to pixels, some rows at a time."""
    step = max(_BLOCK // len(points.area), 1)
    for first in range(0, len(place), step):
        here, up = place[first : first + step], normal[first : first + step]
        way = points.position[:, None] - here
        squared = np.einsum("ijk,ijk->ij", way, way)
        cosines = np.maximum(np.einsum("ijk,jk->ij", way, up), 0)
        cosines *= np.maximum(-np.einsum("ijk,ik->ij", way, points.normal), 0)
        # Point by point: rays of one to neighbouring pixels meet the same of the scene.
        point, pixel = np.nonzero(cosines)
        area, squared = points.area[point], squared[point, pixel]
        share = cosines[point, pixel] / squared * area / (np.pi * squared + area)
        rows = np.zeros((len(here), len(points.area)))
        seen = _embree.unobstructed(scene, points.position[point], here[pixel])
        rows[pixel, point] = share * seen
        yield rows


def _count(name: str, value: Any, most: int | None) -> int:
    limit = "at least 1" if most is None else f"in [1, {most}]"
    is_valid = lambda n: 1 <= n <= (n if most is None else most)
    name = f"scene.transfer({name}=...)"
    count = whole_number(name, value, lambda n: True, "an integer")
    return whole_number(name, count, is_valid, limit)


def _require_embree(caller: str) -> None:
    if problem := _embree.problem():
        raise RuntimeError(f"`scene.{caller}` needs Embree: {problem}")
