"""The record of indirect light: `scene.transfer` computes it, `relight.indirect` uses it."""

from typing import Any, final

import equinox as eqx
from jaxtyping import Array, Float

from jaxfx._checks import parameter


__all__ = ["Transfer"]


@final
class Transfer(eqx.Module):
    """How light that falls on points of a scene reaches the pixels of a deep frame buffer.

    Made by `scene.transfer`, which traces rays; used by `relight.indirect`. It depends on no
    light, so it is computed once for all.

    **Arguments:**

    - `receive`: height width rank; the pixels' side of the matrix, a ratio.
    - `send`: rank point; the points' side, a ratio.
    - `position`: point 3, world space.
    - `normal`: point 3, unit vectors in world space.
    - `diffuse`: point 3, linear RGB reflectance.
    - `exchange`: point point, ratios: what the points (rows) get of what the points (columns)
      send. None where light bounces once only.

    **Raises:** `ValueError` where the shapes do not fit one another.

    **Gradient:** exact with respect to every field.

    **Example:** a single point, from which each of 8 x 8 pixels gets half:

    >>> import jax.numpy as jnp
    >>> from jaxfx import Transfer
    >>> receive, send = jnp.full((8, 8, 1), 0.5), jnp.ones((1, 1))
    >>> transfer = Transfer(receive, send, [[0, 0, 2]], [[0, 0, 1]], [[1, 1, 1]])
    >>> (transfer.receive @ (transfer.send @ transfer.diffuse)).shape
    (8, 8, 3)

    The irradiance of the pixels from the points is `receive @ (send @ b)`, a low-rank matrix
    product, where `b` is what each point sends back: its irradiance times its `diffuse`. The
    irradiance of the points from one another is `exchange @ b`.

    Source: Hasan, Pellacini & Bala 2006, direct-to-indirect transfer.
    """

    receive: Float[Array, "height width rank"]
    send: Float[Array, "rank point"]
    position: Float[Array, "point 3"]
    normal: Float[Array, "point 3"]
    diffuse: Float[Array, "point 3"]
    exchange: Float[Array, "point point"] | None

    def __init__(
        self,
        receive: Any,
        send: Any,
        position: Any,
        normal: Any,
        diffuse: Any,
        exchange: Any = None,
    ):
        self.receive = parameter("Transfer(receive)", receive, None)
        self.send = parameter("Transfer(send)", send, None)
        shape = self.send.shape
        if len(shape) != 2:
            raise ValueError(f"`Transfer(send)` must have shape (rank, point), got {shape}.")
        if self.receive.ndim != 3 or self.receive.shape[2] != shape[0]:
            raise ValueError(
                f"`Transfer(receive)` must have shape (height, width, {shape[0]}), "
                f"got {self.receive.shape}."
            )
        self.position = parameter("Transfer(position)", position, (shape[1], 3))
        self.normal = parameter("Transfer(normal)", normal, (shape[1], 3))
        self.diffuse = parameter("Transfer(diffuse)", diffuse, (shape[1], 3))
        self.exchange = exchange
        if exchange is not None:
            self.exchange = parameter("Transfer(exchange)", exchange, (shape[1], shape[1]))
