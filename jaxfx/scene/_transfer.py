"""Bounces of light: which points see each other, the transfer from surfaces to pixels.

Sample points stand for the surfaces that reflect light. Candidates are drawn uniformly from the
mesh; those that send much light to the image are kept more often. Each sample stands for a disc
of the area that it represents. The transfer matrix from samples to pixels is smooth: a few
singular vectors hold nearly all of it. They are computed from some of its rows, so that the
whole matrix is never in memory.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfx._arguments import check_camera, check_gbuffer
from jaxfx._arrays import ArrayLike
from jaxfx._checks import as_numpy, whole_number
from jaxfx._sampling import pixel_centers
from jaxfx.camera import Camera
from jaxfx.gbuffer import GBuffer
from jaxfx.scene import embree
from jaxfx.scene._scene import Scene
from jaxfx.scene._surface import Hits, at_hits
from jaxfx.transfer import Transfer


# Candidates drawn per sample that is kept. Fewer miss small bright surfaces; more cost rays.
_CANDIDATES = 16
# Pixels to which the candidates' light is computed, to rate them. Fewer rate them by chance.
_RATING_PIXELS = 256
# Added to the rating, whose mean is 1: so surfaces that none of those pixels sees get samples,
# too. With 0 the pixels that see only such a surface would stay dark.
_LEAST_RATING = 0.1
# Rows of the transfer matrix, per sample, from which the singular vectors are computed.
_ROWS_PER_SAMPLE = 4
# Rays cast at once: bounds the memory of a block of rows.
_RAYS_PER_BLOCK = 1 << 20


class _Samples(NamedTuple):
    """Points of the surface, the diffuse colour there, and the area that each stands for."""

    position: Float[np.ndarray, "sample 3"]
    normal: Float[np.ndarray, "sample 3"]
    diffuse: Float[np.ndarray, "sample 3"]
    area: Float[np.ndarray, " sample"]


def visible(
    scene: Scene, origin: Float[ArrayLike, "*place 3"], end: Float[ArrayLike, "*places 3"]
) -> Bool[Array, "..."]:
    """Whether two points see each other: no triangle of the scene lies between them.

    Both may lie on surfaces: 1e-4 of the scene's radius at either end does not count.

    **Arguments:**

    - `scene`: from `load`, `from_trimesh` or `still_life`.
    - `origin`, `end`: world positions; ... 3 each, of shapes that broadcast.

    **Returns:** a bool for each pair.

    **Raises:** `ValueError` for other shapes; `RuntimeError` where Embree does not work.

    **Gradient:** none: this runs on the host, outside every transform.

    **Example:**

    >>> import numpy as np
    >>> import trimesh
    >>> from jaxfx import scene
    >>> box = scene.from_trimesh(trimesh.creation.box((1, 1, 1)))
    >>> print(scene.visible(box, np.array([0.0, 0, 2]), np.array([[0.0, 0, -2], [0, 2, 2]])))
    [False  True]
    """
    require_embree("visible")
    points = []
    for name, value in (("origin", origin), ("end", end)):
        array = as_numpy(f"scene.visible({name})", value)
        if array.shape[-1:] != (3,):
            raise ValueError(
                f"`scene.visible({name})` must have shape (..., 3), got {array.shape}."
            )
        points.append(array.astype(np.float64))
    start, stop = np.broadcast_arrays(*points)
    is_visible = embree.unobstructed(scene, start.reshape(-1, 3), stop.reshape(-1, 3))
    return jnp.asarray(is_visible.reshape(start.shape[:-1]))


def transfer(
    scene: Scene,
    gbuffer: GBuffer,
    camera: Camera,
    *,
    point_count: int = 1024,
    rank: int = 64,
    seed: int = 0,
) -> Transfer:
    """How light that surfaces reflect diffusely reaches each pixel, and one another.

    It is computed once per view. `relight.indirect` then computes the bounces of any lights by
    matrix products.

    **Arguments:**

    - `scene`: the scene that the cache shows.
    - `gbuffer`, `camera`: the cache, height width, and its camera.
    - `point_count`: sample points that stand for the surfaces. They reflect light from their
      faces' fronts (corners counter-clockwise). The error falls as one over its square root.
    - `rank`: singular vectors that are kept; at most `point_count`.
    - `seed`: of the random sample points.

    **Returns:** the `Transfer`, in float32, for `relight.indirect`.

    **Raises:** `ValueError` for a count out of range or a cache that shows nothing;
    `RuntimeError` where Embree does not work.

    **Gradient:** none: this runs on the host, outside every transform.

    **Example:**

    >>> from jaxfx import scene
    >>> mesh = scene.still_life()
    >>> camera = scene.default_camera(mesh, height=6, width=8)
    >>> gbuffer = scene.gbuffer(mesh, camera, height=6, width=8)
    >>> transfer = scene.transfer(mesh, gbuffer, camera, point_count=16, rank=4)
    >>> transfer.receive.shape, transfer.send.shape
    ((6, 8, 4), (4, 16))

    A sample of normal M and area A, at distance r in direction w of a pixel of normal N, sends
    to it `max(N.w, 0) * max(-M.w, 0) * A / (pi * r**2 + A)` of the light that it reflects, if
    they see each other. The matrix of these is kept as its first `rank` singular vectors. It
    takes up to height * width * `point_count` rays, about 2 million per second.

    Source: Hasan, Pellacini & Bala 2006, with singular vectors for their wavelets; the disc is
    Wallace, Elmquist & Haines 1989's.
    """
    require_embree("transfer")
    check_camera("scene.transfer(camera)", camera)
    gbuffer = check_gbuffer("scene.transfer(gbuffer)", gbuffer)
    point_count = _count("point_count", point_count, None)
    rank = _count("rank", rank, point_count)
    is_surface = np.isfinite(gbuffer.depth) & (gbuffer.depth > 0) & (gbuffer.shader >= 0)
    is_surface = np.asarray(is_surface)
    if not is_surface.any():
        raise ValueError("`scene.transfer(gbuffer)` must show something, got nothing.")
    height, width = gbuffer.depth.shape
    pixels = pixel_centers(height, width, gbuffer.depth.dtype)
    position = np.asarray(camera.unproject(pixels, gbuffer.depth), np.float64)[is_surface]
    normal = np.asarray(gbuffer.normal, np.float64)[is_surface]
    rng = np.random.default_rng(seed)

    def random_pixels(count):
        index = rng.choice(len(position), min(count, len(position)), replace=False)
        return position[index], normal[index]

    samples = _choose(scene, point_count, random_pixels(_RATING_PIXELS), rng)
    rows = random_pixels(_ROWS_PER_SAMPLE * point_count)
    gram = sum(block.T @ block for block in _blocks(scene, *rows, samples))
    send = np.linalg.eigh(gram)[1][:, ::-1][:, :rank].T
    receive = np.zeros((height, width, rank), np.float32)
    blocks = _blocks(scene, position, normal, samples)
    receive[is_surface] = np.concatenate([block @ send.T for block in blocks])
    exchange = np.concatenate([*_blocks(scene, samples.position, samples.normal, samples)])
    fields = (send, samples.position, samples.normal, samples.diffuse, exchange)
    return Transfer(receive, *(np.asarray(field, np.float32) for field in fields))


def _choose(
    scene: Scene,
    count: int,
    pixels: tuple[Float[np.ndarray, "pixel 3"], Float[np.ndarray, "pixel 3"]],
    rng: np.random.Generator,
) -> _Samples:
    """`count` samples, denser where they send more light to `pixels` (positions, normals).

    The area of each is divided by its probability, so that sums over samples stay unbiased.
    """
    candidates = _uniform_samples(scene, _CANDIDATES * count, rng)
    # As tiny discs: the rating is of the light sent per area.
    tiny = candidates._replace(area=candidates.area / 1e6)
    rating = np.concatenate([*_blocks(scene, *pixels, tiny)]).mean(axis=0)
    rating = rating / max(rating.mean(), np.finfo(float).tiny) + _LEAST_RATING
    index = _systematic_sample(rating, count, rng)
    area = candidates.area[index] * (rating.sum() / count / rating[index])
    return _Samples(
        candidates.position[index], candidates.normal[index], candidates.diffuse[index], area
    )


def _uniform_samples(scene: Scene, count: int, rng: np.random.Generator) -> _Samples:
    """Samples spread evenly over the surface."""
    a, b, c = scene.vertices[scene.faces].transpose(1, 0, 2)
    cross = np.cross(b - a, c - a)
    double_area = np.linalg.norm(cross, axis=1)
    face = _systematic_sample(double_area, count, rng)
    root, ratio = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1 - root, root * (1 - ratio), root * ratio])
    face_normal = (cross[face] / double_area[face, None]).T
    hits = Hits(np.arange(count), face, np.ones(count), weights, face_normal, -face_normal)
    normal, color, metallic = at_hits(scene, hits)
    position = np.einsum("in,nik->nk", weights, scene.vertices[scene.faces[face]])
    area = np.full(count, double_area.sum() / 2 / count)
    return _Samples(position, normal, color * (1 - metallic)[:, None], area)


def _systematic_sample(
    weights: Float[np.ndarray, " item"], count: int, rng: np.random.Generator
) -> np.ndarray:
    """`count` indices; item i appears `count * weights[i] / sum(weights)` times on average."""
    steps = (np.arange(count) + rng.random()) / count
    total = np.cumsum(weights)
    return np.minimum(np.searchsorted(total, steps * total[-1]), len(weights) - 1)


def _blocks(
    scene: Scene,
    position: Float[np.ndarray, "pixel 3"],
    normal: Float[np.ndarray, "pixel 3"],
    samples: _Samples,
) -> Iterator[Float[np.ndarray, "rows sample"]]:
    """The transfer matrix, pixel x sample, in blocks of rows."""
    step = max(_RAYS_PER_BLOCK // len(samples.area), 1)
    for first in range(0, len(position), step):
        receiver, up = position[first : first + step], normal[first : first + step]
        offset = samples.position[:, None] - receiver
        squared = np.einsum("ijk,ijk->ij", offset, offset)
        cosines = np.maximum(np.einsum("ijk,jk->ij", offset, up), 0)
        cosines *= np.maximum(-np.einsum("ijk,ik->ij", offset, samples.normal), 0)
        # Sample by sample: consecutive rays then go from one point to neighbouring pixels, and
        # visit the same parts of Embree's structure.
        sample, pixel = np.nonzero(cosines)
        area, squared = samples.area[sample], squared[sample, pixel]
        unoccluded = cosines[sample, pixel] / squared * area / (np.pi * squared + area)
        rows = np.zeros((len(receiver), len(samples.area)))
        is_visible = embree.unobstructed(scene, samples.position[sample], receiver[pixel])
        rows[pixel, sample] = unoccluded * is_visible
        yield rows


def _count(name: str, value: Any, largest: int | None) -> int:
    """A static integer in [1, largest]; `ValueError` names it otherwise."""
    limit = "at least 1" if largest is None else f"in [1, {largest}]"
    is_valid = lambda n: 1 <= n <= (n if largest is None else largest)
    name = f"scene.transfer({name}=...)"
    count = whole_number(name, value, lambda n: True, "an integer")
    return whole_number(name, count, is_valid, limit)


def require_embree(caller: str) -> None:
    """Raise `RuntimeError` that names `caller` where Embree does not work."""
    if problem := embree.problem():
        raise RuntimeError(f"`scene.{caller}` needs Embree: {problem}")
