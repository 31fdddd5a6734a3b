"""Light that surfaces send on to others, for the cost of a matrix product a bounce."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfx._arguments import check_gbuffer, check_lights
from jaxfx._checks import WholeNumber, shares, whole_number
from jaxfx._loops import scan
from jaxfx._meshes import on_any_mesh
from jaxfx._numerics import working_dtype
from jaxfx.gbuffer import GBuffer
from jaxfx.light import AmbientLight, Light
from jaxfx.relight.shading import Surface, check_shader, colored, received
from jaxfx.transfer import Transfer


@on_any_mesh
def indirect(
    gbuffer: GBuffer,
    transfer: Transfer,
    lights: Sequence[Light],
    *,
    visibilities: Sequence[Any] | None = None,
    bounces: WholeNumber = 1,
) -> Float[Array, "height width 3"]:
    """The image of one diffuse bounce, or of several: add it to `render`'s.

    It is linear in the lights, so after an edit only the edited light has to be computed again.

    **Arguments:**

    - `gbuffer`: the cache, height width.
    - `transfer`: from `scene.transfer`, of this cache.
    - `lights`: a sequence of lights of any kinds. Ambient ones stand for indirect light
      themselves, and add nothing here.
    - `visibilities`: one per light: for each point of `transfer` a number in [0, 1] or a
      boolean, the share of the light that arrives, or None for all of it. For a point light,
      `scene.visible(mesh, transfer.position, light.position)` computes it. None alone stands
      for no shadows at all.
    - `bounces`: static; how often light is reflected before it reaches the pixels' surfaces.
      More than one need `transfer.exchange`.

    **Returns:** height width 3, linear RGB, in the type of `gbuffer.color`; 0 where the
    shader is -1.

    **Raises:** `ValueError` for another size, an unknown light, `visibilities` that do not
    fit, fewer bounces than one, or more where there is no `exchange`.

    **Gradient:** exact with respect to `gbuffer.diffuse`, every field of `transfer`, the lights
    and `visibilities`, as `shade`'s; zero with respect to the cache's other images.

    **Example:** one point one unit before a wall sends light back to it:

    >>> import jax.numpy as jnp
    >>> from jaxfx import DirectionalLight, GBuffer, Transfer, relight
    >>> white, shader = jnp.ones((8, 8, 3)), jnp.zeros((8, 8), int)
    >>> normal, depth = white * jnp.array([0, 0, -1]), jnp.full((8, 8), 3.0)
    >>> wall = GBuffer(white, shader, white, white / 2, white, normal, depth, depth / 6)
    >>> receive, send = jnp.full((8, 8, 1), 0.5), jnp.ones((1, 1))
    >>> transfer = Transfer(receive, send, [[0, 0, 2]], [[0, 0, 1]], [[1, 1, 1]])
    >>> lamp = DirectionalLight([0, 0, -1], [1, 1, 1])
    >>> print(relight.indirect(wall, transfer, [lamp])[4, 4])
    [0.25 0.25 0.25]

    With E the irradiance of the transfer's points under the lights, the image is
    `gbuffer.diffuse * receive @ (send @ b)` with `b = diffuse * E`. For each bounce more `b`
    becomes `diffuse * (E + exchange @ b)`: one product more, of the points alone, whatever the
    size of the image. What is left out after n bounces is about the surfaces' mean reflectance
    to the power n + 1.

    It is wrong where two surfaces nearly touch, for a point stands for a disc. It has no
    highlights: points send and pixels receive diffuse light alone.

    Source: Hasan, Pellacini & Bala 2006, equation 3; the products of the points are the
    iteration of Goral et al. 1984, radiosity.
    """
    lights = check_lights("indirect(lights)", lights)
    gbuffer = check_shader(check_gbuffer("indirect(gbuffer)", gbuffer))
    if not isinstance(transfer, Transfer):
        kind = type(transfer).__name__
        raise ValueError(f"`indirect(transfer)` must be a Transfer, got {kind}.")
    transfer = Transfer(**vars(transfer))
    bounces = whole_number("indirect(bounces=...)", bounces)
    if bounces > 1 and transfer.exchange is None:
        raise ValueError(
            "`indirect(bounces=...)` must be 1 for a transfer without `exchange`, "
            f"got {bounces}: `scene.transfer` gives one."
        )
    shape = transfer.receive.shape[:2]
    if shape != gbuffer.depth.shape:
        raise ValueError(
            f"`indirect(transfer)` must be of the cache's height and width "
            f"{gbuffer.depth.shape}, got {shape}."
        )
    visibilities = shares(
        "indirect(visibilities=...)", visibilities, len(lights), (len(transfer.position),)
    )
    return _indirect(gbuffer, transfer, lights, visibilities, bounces)


@partial(jax.jit, static_argnames="bounces")
def _indirect(gbuffer, transfer, lights, visibilities, bounces):
    dtype = working_dtype(gbuffer.color.dtype)
    transfer = jax.tree.map(lambda leaf: leaf.astype(dtype), transfer)
    surface = _as_surface(transfer)
    irradiance = jnp.zeros_like(transfer.diffuse)
    for light, visibility in zip(lights, visibilities, strict=True):
        if not isinstance(light, AmbientLight):
            term = colored(light, received(surface, light))[0][0]
            irradiance += (
                term if visibility is None else visibility.astype(dtype)[:, None] * term
            )
    sent = transfer.diffuse * irradiance
    if bounces > 1:
        again = lambda b, _: (transfer.diffuse * (irradiance + transfer.exchange @ b), None)
        sent = scan(again, sent, jnp.arange(bounces - 1))[0]
    image = gbuffer.diffuse.astype(dtype) * (transfer.receive @ (transfer.send @ sent))
    image = jnp.where((gbuffer.shader < 0)[..., None], 0, image)
    return image.astype(gbuffer.color.dtype)


def _as_surface(transfer: Transfer) -> Surface:
    """The transfer's points as a Lambert surface of one row of pixels."""
    position, normal, diffuse = (
        field[None] for field in (transfer.position, transfer.normal, transfer.diffuse)
    )
    zero, one_row = jnp.zeros_like(position), position[..., 0]
    return Surface(
        shader=jnp.zeros(one_row.shape, jnp.int32),
        position=position,
        normal=normal,
        to_camera=zero,
        ambient=zero,
        diffuse=diffuse,
        specular=zero,
        exponent=jnp.zeros_like(one_row),
        facing=None,
        lobe=None,
        conserves=None,
    )
