"""Lights within an error."""

from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxfx._arguments import check_camera, check_gbuffer, check_lights
from jaxfx._checks import Number, shares
from jaxfx.budget._light_energy import light_energy
from jaxfx.budget._lights_by_tile import try_tiles
from jaxfx.budget._merged_lights import try_merging
from jaxfx.budget._search import Part, Search, check_call
from jaxfx.budget.plan import Plan
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.gbuffer import GBuffer
from jaxfx.light import Light
from jaxfx.relight.shading import check_shader, render


# Merged lights are tried in every fourth pixel of a row and of a column, if the image has as
# many pixels as the second number; on fewer, the time would be that of the calls.
_EVERY, _MANY = 4, 4096


class Everything(eqx.Module):
    """All lights and all shadows."""

    title: ClassVar[str] = "relighting"

    def __call__(self, gbuffer: Any, camera: Any, lights: Any, visibilities: Any = None) -> Any:
        """The image, as `relight.render` draws it."""
        return render(gbuffer, camera, lights, visibilities=visibilities)


def relight(
    gbuffer: GBuffer,
    camera: PinholeCamera | OrthographicCamera,
    lights: Sequence[Light],
    *,
    max_error: Number,
    visibilities: Sequence[Any] | None = None,
) -> Plan:
    """The fewest lights within an error of `relight.render` under all of them.

    For a scene of many lights that is drawn again and again. The plan also says which shadow
    maps need not be made.

    **Arguments:**

    - `gbuffer`, `camera`: as in `relight.render`, height width.
    - `lights`: a sequence of lights of any kinds.
    - `max_error`: root mean square, linear image units, over all pixels and channels.
    - `visibilities`: as in `relight.render`: for each light height width in [0, 1], or None if
      it has no shadows. None alone stands for no shadows at all.

    **Returns:** a `Plan`, to be called with `gbuffer, camera, lights` and, where there are
    shadows, `visibilities`: as many as there are here, None for those that are left out.

    **Raises:** `ValueError` as `relight.render`, for a negative `max_error` or traced data.

    **Gradient:** none through the choice. The plan's image has that of `relight.render` in
    the lights that are kept or merged; in the others it is zero.

    **Example:** a dark light is left out.

    >>> import numpy as np
    >>> from jaxfx import GBuffer, PinholeCamera, PointLight, budget
    >>> white, shader = np.ones((8, 8, 3)), np.zeros((8, 8), int)
    >>> normal, depth = np.broadcast_to([0.0, 0, -1], (8, 8, 3)), np.full((8, 8), 2.0)
    >>> gbuffer = GBuffer(white, shader, white, white, white, normal, depth, depth / 4)
    >>> camera = PinholeCamera.from_fov(1.0, height=8, width=8)
    >>> lights = [PointLight([0, 0, 0], [1, 1, 1]), PointLight([0, 0, 0], [0, 0, 0])]
    >>> plan = budget.relight(gbuffer, camera, lights, max_error=0.01)
    >>> float(plan.predicted_error) <= 0.01, plan(gbuffer, camera, lights).shape
    (True, (8, 8, 3))

    Each light is shaded once, alone. What it brings to a tile of 8 x 8 pixels bounds what is
    missing there without it; lights are left out tile by tile, over the whole image those first
    that bring least, for as long as the sum of the bounds is within the error. A light that is
    needed in a few tiles is computed in these. A light whose shadow takes next to nothing away
    goes without: its shadow map need not be made.

    Apart from that, lights are merged: of one kind those first that are dim and near (spot
    lights: that also shine alike), into the fewest that keep to the error in every fourth pixel
    of a row and of a column; found by halving. The quicker of both candidates is taken, if its
    error holds on the whole image.

    It costs two renderings, one for the proof and one light by light, one by each of the two
    candidates, and about half of one to merge.

    Source: tiles with their own lights are Olsson & Assarsson's 2011, tiled shading; one light
    for a near and dim group is Walter et al.'s 2005, lightcuts.
    """
    gbuffer = check_shader(check_gbuffer("relight(gbuffer)", gbuffer))
    check_camera("relight(camera)", camera)
    lights = check_lights("relight(lights)", lights)
    name, shape = "relight(visibilities=...)", gbuffer.depth.shape
    checked = tuple(shares(name, visibilities, len(lights), shape))
    data = (gbuffer, camera, lights)
    data = data if visibilities is None else (*data, checked)
    max_error = check_call("relight", max_error, data)
    parts = _parts(gbuffer, camera, *data[2:])
    search = Search(Everything(), data, max_error, parts)
    if lights:
        brought = light_energy(gbuffer, camera, lights, checked)
        try_merging(search, brought, lights)
        try_tiles(search, brought)
    return search.plan()


def _parts(gbuffer: GBuffer, camera: Any, *lights: Any) -> list[Part]:
    """Some pixels of a scene, in rows and columns, as a camera of fewer pixels sees them."""
    if gbuffer.depth.size < _MANY:
        return []
    some = (slice(_EVERY // 2, None, _EVERY),) * 2
    # The pixel centers of the one camera at those of the other.
    shift = 0.5 - (_EVERY // 2 + 0.5) / _EVERY
    pose = camera.world_from_camera
    if isinstance(camera, OrthographicCamera):
        scale, centre = camera.pixels_per_unit / _EVERY, camera.center / _EVERY + shift
        camera = OrthographicCamera(scale, centre, pose)
    else:
        fewer = np.array([[1 / _EVERY, 0, shift], [0, 1 / _EVERY, shift], [0, 0, 1]])
        fewer = fewer.astype(camera.intrinsics.dtype)
        camera = PinholeCamera(fewer @ camera.intrinsics, pose)
    lights, *visibilities = lights
    visibilities = jax.tree.map(lambda x: jnp.asarray(x)[some], visibilities)
    return [Part((jax.tree.map(lambda x: x[some], gbuffer), camera, lights, *visibilities))]
