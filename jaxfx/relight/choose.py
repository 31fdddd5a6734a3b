"""Which of many caches to synthesize a new view from."""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Num

from jaxfx._arrays import ArrayLike
from jaxfx._checks import Number, WholeNumber, number, whole_number
from jaxfx._choice import Choice
from jaxfx._meshes import on_any_mesh
from jaxfx._numerics import safe_divide
from jaxfx._sampling import pixel_centers
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.gbuffer import GBuffer
from jaxfx.relight._new_view import check_caches, check_new_depth, look_up, points


# What a cache earns at a pixel by seeing it, beside at most 1 for detail. At 0 a near camera
# that sees little is taken before a far one that sees all; a large number ignores resolution.
_FOR_SEEING = 3


@on_any_mesh
def choose(
    gbuffers: Sequence[GBuffer],
    cameras: Sequence[PinholeCamera | OrthographicCamera],
    target: PinholeCamera | OrthographicCamera,
    *,
    depth: Num[ArrayLike, "height width"],
    count: WholeNumber,
    tolerance: Number = 0.005,
    stride: WholeNumber = 8,
) -> Choice:
    """The few caches that serve a new view best, the most useful first.

    Hand them to `synthesize` in place of all. The first sees most of the view in most detail;
    each next one adds most to those before it.

    **Arguments:**

    - `gbuffers`, `cameras`, `target`, `depth`, `tolerance`: as in `synthesize`.
    - `count`: static; how many to choose, from 1.
    - `stride`: static, pixels; every `stride`-th pixel of the view is looked at.

    **Returns:** a `Choice`: `chosen` and `worth`, each of shape count. At a pixel that a cache
    sees, its worth is between 3/4 and 1, and 1 where no other cache has more pixels on the
    surface there; at others it is 0.

    **Raises:** `ValueError` as `synthesize`, and for a `count` or `stride` out of range.

    **Gradient:** of `worth`, through the detail, with respect to `depth`, the normals and the
    cameras; missing: what is visible, and the choice itself.

    **Example:**

    >>> import jax.numpy as jnp
    >>> from jaxfx import GBuffer, PinholeCamera, relight
    >>> view = {"fov_y": 0.7, "height": 8, "width": 8, "up": [0, -1, 0]}
    >>> front = PinholeCamera.look_at([0, 0, 0], [0, 0, 3], **view)
    >>> back = PinholeCamera.look_at([0, 0, 0], [0, 0, -3], **view)
    >>> ones = jnp.ones((8, 8, 3))
    >>> facing = -ones.at[..., :2].set(0)
    >>> shader, depth = jnp.zeros((8, 8), int), jnp.full((8, 8), 3.0)
    >>> cache = GBuffer(ones, shader, ones, ones, ones, facing, depth, depth / 6)
    >>> choice = relight.choose([cache, cache], [back, front], front, depth=depth, count=1)
    >>> print(choice.chosen, choice.worth)
    [1] [1.]

    Source: our own; the greedy choice is within 1 - 1/e of the best (Nemhauser, Wolsey &
    Fisher 1978).
    """
    caches = check_caches("choose", gbuffers, cameras, target)
    most = len(caches[0])
    in_range = lambda n: 1 <= n <= most
    count = whole_number("choose(count=...)", count, in_range, f"in [1, {most}]")
    stride = whole_number("choose(stride=...)", stride, expected="at least 1")
    tolerance = number("choose(tolerance=...)", tolerance)
    depth = check_new_depth("choose", depth)
    options = {"count": count, "tolerance": tolerance, "stride": stride}
    return _choose(*caches, target, depth, **options)


@partial(jax.jit, static_argnames=("count", "tolerance", "stride"))
def _choose(gbuffers, cameras, target, depth, *, count, tolerance, stride):
    rows, columns = (slice(min(stride, side) // 2, None, stride) for side in depth.shape)
    pixels = pixel_centers(depth.shape[0], depth.shape[1], depth.dtype)[rows, columns]
    point = points(target, pixels, depth[rows, columns])
    samples = [
        look_up(gbuffer, camera, point, tolerance)
        for gbuffer, camera in zip(gbuffers, cameras, strict=True)
    ]
    # cache height width
    detail = jnp.stack([jnp.where(s.is_visible & point.is_known, s.detail, 0) for s in samples])
    most_detail = jnp.max(detail, axis=0, keepdims=True)
    relative = safe_divide(detail, jnp.broadcast_to(most_detail, detail.shape))
    worth = jnp.where(relative > 0, (_FOR_SEEING + relative) / (_FOR_SEEING + 1), 0)
    best, is_taken = jnp.zeros_like(worth[0]), jnp.zeros(len(samples), bool)
    chosen, reached = [], []
    for _ in range(count):
        gain = jnp.sum(jnp.maximum(worth - best[None], 0), axis=(1, 2))
        index = jnp.argmax(jnp.where(is_taken, -1, gain)).astype(jnp.int32)
        best, is_taken = jnp.maximum(best, worth[index]), is_taken.at[index].set(True)
        chosen.append(index)
        reached.append(jnp.mean(best))
    return Choice(jnp.stack(chosen), jnp.stack(reached))
