"""Lights within an error."""

from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from jaxfx._numerics import working_dtype
from jaxfx.budget._plan import Plan, check_call, plan, root_mean_square, timed
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.gbuffer import GBuffer
from jaxfx.light import Light
from jaxfx.relight.shading import render, shade


class Render(eqx.Module):
    """`relight.render` under some of the lights."""

    kept: tuple[int, ...] = eqx.field(static=True)
    title: ClassVar[str] = "relighting"

    def __call__(self, gbuffer: Any, camera: Any, lights: Any) -> Any:
        """As the effect."""
        return render(gbuffer, camera, [lights[index] for index in self.kept])


def relight(
    gbuffer: GBuffer,
    camera: PinholeCamera | OrthographicCamera,
    lights: Sequence[Light],
    *,
    max_error: int | float,
) -> Plan:
    """The fewest lights within an error of `relight.render` under all of them.

    Each light is shaded once, alone. From the dimmest on, lights are dropped for as long as all
    that they bring together is within the error.

    **Arguments:**

    - `gbuffer`, `camera`: as in `relight.render`, height width.
    - `lights`: a sequence of lights of any kinds.
    - `max_error`: root mean square, linear image units, over all pixels and channels.

    **Returns:** a `Plan`, to be called with `gbuffer, camera, lights`, as many lights as there
    are here.

    **Raises:** `ValueError` as `relight.render`, for a negative `max_error` or traced data.

    **Gradient:** none through the choice. The plan's picture has that of `relight.render` in
    the lights that are kept; in the others it is zero.
    """
    max_error = check_call("relight", max_error, (gbuffer, camera, lights))
    alone = [root_mean_square(shade(gbuffer, camera, light)) for light in lights]
    wide = working_dtype(gbuffer.color.dtype)
    missing, error, dropped = jnp.zeros(gbuffer.color.shape, wide), 0.0, []
    for index in sorted(range(len(lights)), key=alone.__getitem__):
        missing = missing + shade(gbuffer, camera, lights[index]).astype(wide)
        if root_mean_square(missing) > max_error:
            break
        error = root_mean_square(missing)
        dropped.append(index)
    kept = tuple(index for index in range(len(lights)) if index not in dropped)
    data = (gbuffer, camera, tuple(lights))
    full = timed(Render(tuple(range(len(lights)))), data)[1]
    seconds = timed(Render(kept), data)[1] if dropped else full
    sentences = [
        f"light {index}, for it brings {alone[index]:.2g}." for index in sorted(dropped)
    ]
    return plan(Render(kept), error, seconds, full, sentences)
