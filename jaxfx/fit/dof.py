"""The lens and the amplifications of a picture with depth of field."""

import dataclasses
import functools as ft
import math
from collections.abc import Callable, Collection
from typing import Any, Literal, final, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Float, Num

from jaxfx._arguments import check_lens
from jaxfx._checks import (
    Number,
    WholeNumber,
    check,
    check_depth,
    check_image,
    number,
    option,
    parameter,
    whole_number,
)
from jaxfx._progress import Bar
from jaxfx.dof._inputs import largest_coc
from jaxfx.dof._sprites import POINT_RADIUS
from jaxfx.dof.layered import layered
from jaxfx.dof.scatter import scatter
from jaxfx.fit._descent import End, Solver, covariance, descend, tiles
from jaxfx.lens import ThinLens


PARAMETERS = ("aperture", "focus_distance", "gamma", "epsilon")
LAYERED_PARAMETERS = ("aperture", "focus_distance", "threshold")

# Start values of zero have no logarithm.
_SMALLEST = 1e-6
_EPSILON_RESTARTS = (2.0, 0.5)
# How much larger than its start's largest circle of confusion a search may draw, and how often
# one goes on with more room from where it ran out.
_ROOM, _ROUNDS = 1.5, 4

Method = Literal["scatter", "layered"]
_Unknowns = dict[str, Float[Array, ""]]


@final
class DofFit(eqx.Module):
    """What `dof` found.

    - `lens`, `gamma`, `epsilon`, `threshold`: the parameters, lengths in scene units, a number,
      and pixels twice; frozen ones, and those of the other method, as they were given.
    - `image`: height width channel, the picture with them.
    - `losses`: the mean squared residual at the start and after every step, in squared units
      of radiance; it may rise where the search starts again.
    - `uncertainty`: a standard error for each fitted parameter, in its own unit. It takes the
      residuals of 8 x 8 tiles of the image for independent of one another, and no others. A
      parameter that the image does not tell has a large one, or inf. It knows nothing of other
      minima, nor of what the method itself gets wrong, as at the edges of near surfaces.
    - `clamped`: the share of pixels, a ratio, whose circle of confusion in the fitted lens is
      larger than `max_coc`. Above 0, the fit may be biased: repeat it with a larger `max_coc`.
    - `result`: optimistix' verdict, one of its `RESULTS`; it prints as a sentence.
    """

    lens: ThinLens
    gamma: Float[Array, ""]
    epsilon: Float[Array, ""]
    threshold: Float[Array, ""]
    image: Float[Array, "height width channel"]
    losses: Float[Array, " steps"]
    uncertainty: dict[str, Float[Array, ""]]
    clamped: Float[Array, ""]
    result: optx.RESULTS

    @property
    def success(self) -> bool:
        """Whether the solver converged."""
        return bool(self.result == optx.RESULTS.successful)


def dof(
    reference: Float[ArrayLike, "height width channel"],
    image: Float[ArrayLike, "height width channel"],
    depth: Num[ArrayLike, "height width"],
    lens: ThinLens,
    *,
    gamma: Float[ArrayLike, ""] | float = 1.0,
    epsilon: Float[ArrayLike, ""] | float = 2.0,
    method: Method = "scatter",
    threshold: Float[ArrayLike, ""] | float = 2.0,
    behind: tuple[Float[ArrayLike, "height width channel"], Num[ArrayLike, "height width"]]
    | None = None,
    max_coc: Number | None = None,
    weights: Num[ArrayLike, "height width"] | None = None,
    solver: Solver | None = None,
    parameters: Collection[str] | None = None,
    max_steps: WholeNumber = 64,
    throw: bool = True,
    progress: bool = False,
) -> DofFit:
    """The lens and the other parameters that make a method look most like a reference.

    Least squares over all pixels and channels. All but gamma are searched by their logarithms
    and gamma by its inverse softplus, so that each stays positive. The squares have local
    minima in epsilon: from the solution the search starts again with half and with twice its
    epsilon, and the best of the three ends is kept.

    **Arguments:**

    - `reference`: height width channel, linear radiance: a photograph or a multi-pass picture.
    - `image`, `depth`: height width channel and height width, as in the method.
    - `lens`: where the search starts, lengths in scene units; `focal_pixels` is never fitted.
    - `gamma`, `epsilon`: where the search starts, no unit and pixels; of `"scatter"`.
    - `method`: the one of `jaxfx.dof` whose parameters are sought.
    - `threshold`, `behind`: where the search starts, in pixels, and the second layer, as in
      `dof.layered`; of `"layered"`.
    - `max_coc`: static; the largest diameter, in pixels, that the search may draw. By default
      half as large again as the start's largest, and larger wherever that proves too small.
    - `weights`: height width, no unit: how much the square of each pixel's difference counts;
      0 leaves a pixel out. Pixels beside steps in depth show surfaces that the image lacks, and
      highlights have squares that decide alone: both are worth leaving out.
    - `solver`: any least-squares solver or minimiser of optimistix. By default
      Levenberg-Marquardt, which has also converged where six steps gain next to nothing.
    - `parameters`: the names to fit, out of `fit.PARAMETERS` or, of `"layered"`, out of
      `fit.LAYERED_PARAMETERS`; the others stay as given. By default all of them.
    - `max_steps`: of the solver, each time it starts.
    - `throw`: raise where the solver fails; else the failure stands in the result.
    - `progress`: show a bar on stderr; it needs the extra `plot`.

    **Returns:** a `DofFit`.

    **Raises:** `ValueError` for what the method refuses, for shapes that differ, an unknown
    or empty choice of parameters, a lens to start from that can't move (a zero aperture; all
    circles of confusion below a pixel or above `max_coc`), or a picture that is not finite.
    `RuntimeError` where the solver fails and `throw` is true.

    **Gradient:** none through the search: it stops at every step to report.
    """
    reference, image, depth = _pictures(reference, image, depth)
    option("dof(method=...)", method, get_args(Method))
    start = _start(lens, gamma, epsilon, threshold, image.dtype)
    unknowns = {name: _unconstrain(name, start[name]) for name in _names(method, parameters)}
    max_steps = whole_number("dof(max_steps=...)", max_steps)
    if max_coc is not None:
        max_coc = number("dof(max_coc=...)", max_coc, lambda x: 0 < x < math.inf)
    _check_moves(unknowns, lens, depth, behind, max_coc)
    root = _root_of_weights(weights, image)
    model = _Model(image, depth, behind, lens.focal_pixels, start, method, max_coc)
    with Bar(progress, "fit") as bar:
        solve = lambda model, y: descend(
            _Residual(model, reference, root), y, solver=solver, max_steps=max_steps, bar=bar
        )
        model, end = _search(model, unknowns, solve)
    if throw:
        end.check("dof", "lens")
    return _fitted(model, end, reference, root)


def _fitted(model: "_Model", end: End, reference: Array, root: Array) -> DofFit:
    """The result at the end of a search: parameters, image and standard errors."""
    found = _constrain(end.unknowns, reference.dtype)
    values = model.start | found
    fitted = _drawn(model, found)
    residual = root * (fitted - reference)
    columns = root.repeat(reference.shape[2], axis=2).reshape(-1, 1) * _columns(model, found)
    block, count = tiles(residual.shape)
    errors = jnp.sqrt(jnp.diagonal(covariance(columns, residual.reshape(-1), block, count)))
    return DofFit(
        model.lens(found),
        values["gamma"],
        values["epsilon"],
        values["threshold"],
        fitted,
        jnp.stack(end.losses),
        dict(zip(found, errors, strict=True)),
        model.clamped(found),
        end.result,
    )


def _pictures(reference: Any, image: Any, depth: Any) -> tuple[Array, Array, Array]:
    """The pictures, checked, in the type of `image`."""
    image = check_image("dof(image)", image)
    reference = check_image("dof(reference)", reference)
    depth = check_depth("dof(depth)", depth, image.shape[:2])
    if reference.shape != image.shape:
        raise ValueError(
            f"`dof(reference)` must have the image's shape {image.shape}, "
            f"got {reference.shape}."
        )
    for name, value in (("image", image), ("reference", reference)):
        check(f"dof({name})", value, np.isfinite, "finite")
    check("dof(depth)", depth, lambda v: (v > 0).any(), "known somewhere")
    return reference.astype(image.dtype), image, depth


def _root_of_weights(weights: Any, image: Array) -> Float[Array, "height width 1"]:
    """The factor of each pixel's difference, in the type of `image`."""
    if weights is None:
        return jnp.ones((*image.shape[:2], 1), image.dtype)
    weights = check_depth("dof(weights=...)", weights, image.shape[:2])
    is_weight = lambda v: (np.isfinite(v) & (v >= 0)).all() and (v > 0).any()
    check("dof(weights=...)", weights, is_weight, "finite, 0 or positive, and not all 0")
    return jnp.sqrt(weights).astype(image.dtype)[..., None]


def _start(lens: Any, gamma: Any, epsilon: Any, threshold: Any, dtype: DTypeLike) -> _Unknowns:
    """All parameters where the search starts, checked, in one type."""
    if not isinstance(lens, ThinLens):
        raise ValueError(f"`dof(lens)` must be a ThinLens, got {type(lens).__name__}.")
    check_lens("dof(lens)", lens)
    check("dof(lens.aperture)", lens.aperture, lambda v: v > 0, "positive to start a search")
    start = {
        "aperture": lens.aperture,
        "focus_distance": lens.focus_distance,
        "gamma": parameter("dof(gamma=...)", gamma),
        "epsilon": parameter("dof(epsilon=...)", epsilon),
        "threshold": parameter("dof(threshold=...)", threshold),
    }
    for name in ("gamma", "epsilon", "threshold"):
        check(f"dof({name}=...)", start[name], lambda v: v >= 0, "0 or positive")
    return {name: value.astype(dtype) for name, value in start.items()}


def _check_moves(
    names: Collection[str], lens: ThinLens, depth: Array, behind: Any, max_coc: Any
) -> None:
    """`ValueError` for a lens to be found of which no circle of confusion has a derivative."""
    if not {"aperture", "focus_distance"}.intersection(names):
        return
    depths = [depth]
    if behind is not None:
        depths.append(check_depth("dof(behind=...)", behind[1], depth.shape))
    circles = [jnp.where(d > 0, lens.circle_of_confusion(d), jnp.nan) for d in depths]
    circles = jnp.stack(circles)
    most = math.inf if max_coc is None else max_coc
    # What is no diameter at all is named by the method.
    if most <= 0 or bool(((circles > 2 * POINT_RADIUS) & (circles < most)).any()):
        return
    least, largest = (float(each(circles)) for each in (jnp.nanmin, jnp.nanmax))
    raise ValueError(
        "`dof(lens)` must start with a circle of confusion between a pixel and `max_coc` "
        "somewhere, for no other has a derivative that could move the aperture or the focus "
        f"distance, got circles from {least:.3g} to {largest:.3g} pixels and "
        f"`max_coc` {max_coc}."
    )


def _names(method: Method, parameters: Collection[str] | None) -> list[str]:
    known = PARAMETERS if method == "scatter" else LAYERED_PARAMETERS
    names = [name for name in known if parameters is None or name in parameters]
    if not names or (parameters is not None and len(names) != len(parameters)):
        raise ValueError(
            f"`dof(parameters=...)` must name some of {known}, got {tuple(parameters or ())}."
        )
    return names


def _unconstrain(name: str, value: Array) -> Array:
    # In JAX's default type: that is the type of the solvers' own numbers.
    value = jnp.maximum(value.astype(float), _SMALLEST)
    return value + jnp.log(-jnp.expm1(-value)) if name == "gamma" else jnp.log(value)


def _constrain(unknowns: _Unknowns, dtype: DTypeLike) -> _Unknowns:
    return {
        name: (jax.nn.softplus if name == "gamma" else jnp.exp)(value).astype(dtype)
        for name, value in unknowns.items()
    }


class _Model(eqx.Module):
    """The method as a function of some of its parameters, the others as at the start."""

    image: Float[Array, "height width channel"]
    depth: Float[Array, "height width"]
    behind: tuple[Any, Any] | None
    focal_pixels: Float[Array, ""]
    start: _Unknowns
    method: Method = eqx.field(static=True)
    max_coc: int | float | None = eqx.field(static=True)

    def lens(self, values: _Unknowns) -> ThinLens:
        values = self.start | values
        return ThinLens(values["aperture"], values["focus_distance"], self.focal_pixels)

    def __call__(self, values: _Unknowns) -> Float[Array, "height width channel"]:
        lens, values = self.lens(values), self.start | values
        names = ("gamma", "epsilon") if self.method == "scatter" else ("threshold",)
        options: dict[str, Any] = {name: values[name] for name in names}
        draw = scatter if self.method == "scatter" else ft.partial(layered, behind=self.behind)
        return draw(self.image, self.depth, lens, max_coc=self.max_coc, **options)

    def with_room(self, values: _Unknowns) -> "_Model":
        """The model that draws the circles of these values and still larger ones."""
        room = _ROOM * largest_coc("dof", self.depth, self.lens(values))
        return dataclasses.replace(self, max_coc=room)

    def clamped(self, values: _Unknowns) -> Float[Array, ""]:
        """The share of pixels whose circles it can't draw in full."""
        assert self.max_coc is not None
        circles = self.lens(values).circle_of_confusion(self.depth)
        return jnp.mean((circles > self.max_coc) & (self.depth > 0))


def _search(
    model: _Model, unknowns: _Unknowns, solve: Callable[[_Model, _Unknowns], End]
) -> tuple[_Model, End]:
    """The best end from `unknowns`, under the first model that has room for it."""
    fixed = model.max_coc is not None
    values = lambda unknowns: _constrain(unknowns, model.image.dtype)
    model = model if fixed else model.with_room(values(unknowns))
    end = solve(model, unknowns)
    losses = end.losses
    for _ in range(0 if fixed else _ROUNDS):
        if model.clamped(values(end.unknowns)) == 0:
            break
        model = model.with_room(values(end.unknowns))
        end = solve(model, end.unknowns)
        losses = losses + end.losses
    for factor in _EPSILON_RESTARTS if "epsilon" in unknowns else ():
        epsilon = end.unknowns["epsilon"] + math.log(factor)
        again = solve(model, end.unknowns | {"epsilon": epsilon})
        losses = losses + again.losses
        if again.result == optx.RESULTS.successful and again.losses[-1] < end.losses[-1]:
            end = again
    return model, end._replace(losses=losses)


class _Residual(eqx.Module):
    """The picture less the reference, as a function of what is searched."""

    model: _Model
    reference: Float[Array, "height width channel"]
    root: Float[Array, "height width 1"]

    def __call__(self, unknowns: _Unknowns) -> Float[Array, "height width channel"]:
        values = _constrain(unknowns, self.reference.dtype)
        return (self.root * (self.model(values) - self.reference)).astype(float)


@eqx.filter_jit
def _drawn(model, values):
    return model(values)


@eqx.filter_jit
def _columns(model, values):
    """The Jacobian in the order of `values`, by forward mode."""
    jacobian = jax.jacfwd(model)(values)
    return jnp.stack([jacobian[name].reshape(-1) for name in values], axis=1)
