"""A loss of the user's own as an objective: any function of the picture that Dr.Jit differentiates.

A step draws the picture as `eigengs_dr.render` does, differentiates the function with respect to
it, and passes the derivative to the adjoint. Between steps, the controls see a quadratic model of
the loss, just as they see the squared error of an image.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from inspect import signature
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import drjit as dr
import numpy as np

from ..backend.arrays import types_of
from ..backend.entry_points import check_types
from ..backend.messages import shown
from ..backend.recording import collector_off, freeze_program
from ..backend.types import Float, Record, Tensor
from ..gaussian.gaussians import Gaussians, broadcast_rows
from ..image.space import Affine
from ..raster.kernels import forward
from ..raster.lists import TileLists
from ..raster.parameters import detached_shape, kernel_radius, pack_parameters
from ..raster.render import bin_gaussians, to_tensor
from ..raster.tiles import Grid
from .channels import Channels

if TYPE_CHECKING:
    from .state import State


LossFunction: TypeAlias = Callable[[Any, int], Any]
"""``function(picture, step) -> number``, see `Loss`."""


@dataclass(frozen=True, eq=False)
class Loss:
    """What a fit minimises instead of the squared error of an image.

    Attributes
    ----------
    function : callable
        ``function(picture, step) -> number``. The picture is a tensor (H, W, C) of Dr.Jit, as
        `eigengs_dr.render` returns it; for maps, a dict of tensors. The number is an array or a
        tensor of Dr.Jit of one value that depends on the picture; where it does not, at some steps,
        nothing moves. The step is the number of steps taken before, over the whole fit: it may
        choose a camera, or seed random numbers. Rows of the trace call the function for step 0,
        and controls between steps for the next one. Without an image, a judge or a target, only
        the rows of the first and of the last set call it; others hold the mean of the steps since
        the row before.
    bounds : (float, float), optional
        Smallest and largest value of the picture, such as ``(0, 1)``: the function sees the picture
        clipped, and sums outside are pulled back.
    parameters : optimiser of Dr.Jit, optional
        Your own optimiser, such as a ``drjit.opt.Adam``, that steps along: the derivatives by its
        parameters are computed too, and then its ``step()`` is called.
    judge : callable, optional
        ``judge(picture) -> number``: what the rows of the trace measure and the best set minimises,
        such as the error in photos that the function does not see. By default
        ``function(picture, 0)``. Its number may be one of Python, NumPy or PyTorch too.
    target : float, optional
        Value to reach with as few Gaussians as possible, instead of their number.
    space : str or mapping of str to str, optional
        Space of the sums without an image, if `eigengs_dr.fit` is given none.
    pixels : int, optional
        Number of pixels that the function looks at, such as those of all photos of a texture. More
        than one Gaussian for 3 of them would show their noise: without an image or a number, there
        are no more. A step of such a function sees a part of them, as one photo; see
        `eigengs_dr.fitting.coarse.Agreeing` for what follows.

    Raises
    ------
    ValueError
        If the bounds are not two finite numbers that rise, the target is no number above 0, or
        there are no pixels.
    TypeError
        If the function or the judge takes other arguments, the function is frozen already, or the
        parameters are no optimiser.

    Examples
    --------
    >>> import drjit as dr
    >>> import eigengs_dr as eg
    >>> photo = eg.sample("coffee")[:32, :32]
    >>> def l1(picture, step):
    ...     return dr.mean(dr.abs(picture - type(picture)(photo)), axis=None)
    >>> result = eg.fit(photo, 50, iterations=20, space="rgb", loss=eg.Loss(l1))
    >>> result.trace[-1]["loss"] < result.trace[0]["loss"]
    True
    """

    function: LossFunction
    bounds: tuple[float, float] | None = None
    parameters: Any = None
    judge: Callable[[Any], Any] | None = None
    target: float | None = None
    space: str | Mapping[str, str] | None = None
    pixels: int | None = None

    def __post_init__(self) -> None:
        if isinstance(self.function, Loss):
            raise TypeError(
                "Loss: the function is a Loss; change one by dataclasses.replace(loss, bounds=...)"
            )
        if not callable(self.function):
            raise TypeError(f"Loss: {shown(self.function)} is no function of (picture, step)")
        if hasattr(self.function, "n_recordings"):
            raise TypeError(
                "Loss: the function is frozen by drjit.freeze, which passes no derivative on; give "
                "the function itself"
            )
        _check_arguments("function", self.function, "picture, step")
        if self.judge is not None:
            if not callable(self.judge):
                raise TypeError(f"Loss: judge is {shown(self.judge)}; give a function of a picture")
            _check_arguments("judge", self.judge, "picture")
        steps = hasattr(self.parameters, "step") and hasattr(self.parameters, "values")
        if self.parameters is not None and not steps:
            raise TypeError(
                f"Loss: parameters are {type(self.parameters).__name__}; give an optimiser of "
                "Dr.Jit, such as drjit.opt.Adam"
            )
        if self.bounds is not None:
            object.__setattr__(self, "bounds", _check_bounds(self.bounds))
        for name, value in check_types(vars(self), Loss.__annotations__).items():
            object.__setattr__(self, name, value)
        if self.target is not None and not 0 < self.target < math.inf:
            raise ValueError(f"Loss: target is {self.target}; it must be finite and above 0")
        if self.pixels is not None and self.pixels < 1:
            raise ValueError(f"Loss: pixels is {self.pixels}; it must be at least 1")


def _check_bounds(bounds: Any) -> tuple[float, float]:
    """Return bounds as two numbers; raise ValueError unless they are finite and rise."""
    try:
        low, high = (check_types({"": b}, {"": "float"})[""] for b in bounds)
        if not math.isfinite(high - low):
            raise ValueError
    except (TypeError, ValueError):
        raise ValueError(f"Loss: bounds are {shown(bounds)}; give two numbers") from None
    if not low < high:
        raise ValueError(f"Loss: bounds are {bounds}; the first must be the smaller")
    return low, high


def _check_arguments(name: str, function: Callable[..., Any], arguments: str) -> None:
    """Raise `TypeError` if a function of the user cannot be called with some arguments."""
    try:
        takes = signature(function)
    except (TypeError, ValueError):  # of a function in C, which has none
        return
    try:
        takes.bind(*arguments.split(", "))
    except TypeError:
        called = getattr(function, "__name__", type(function).__name__)
        raise TypeError(
            f"Loss: the {name} {called}{takes} is called with ({arguments}); let it take these"
        ) from None


def show(shown: Sequence[Channels], sums: Float, number: int) -> list[Float]:
    """Return the pictures of sums of so many channels, all as rows of pixels; differentiable.

    Cost: a gather for each channel; none for a single picture of unchanged sums.
    """
    types, pictures = types_of(sums), []
    first = dr.arange(types.UInt, dr.width(sums) // number) * number
    for channels in shown:
        unit = channels.unit()
        if channels.space.identical and channels.number == number and unit == Affine():
            return [sums]
        planes = [
            dr.gather(types.Float, sums, first + k, mode=dr.ReduceMode.NoConflicts)
            for k in range(channels.part.start, channels.part.stop)
        ]
        planes = [dr.fma(plane, unit.scale, unit.offset) for plane in planes]
        pictures.append(dr.ravel(types.FloatX(channels.space.decode(planes))))
    return pictures


@dataclass
class Calls:
    """What the calls of a loss for its derivative have shown so far.

    Attributes
    ----------
    step : int
        Number of steps taken.
    unit : float or None
        Power of two that brings the mean absolute derivative by a value of the picture to about
        `USUAL`, as found at the first one that is not 0. Otherwise the unit of a loss would decide
        what the epsilon of an optimiser holds back.
    depends, is_zero : bool
        Whether a value depended on the picture, and whether all values were 0.
    broken : int or None
        The last step that `check_slopes` looked at, if its derivative was not finite.
    since, sum : int, float
        The step after the last call of `recent`, and the sum of the values checked from there on.
    """

    step: int = 0
    unit: float | None = None
    depends: bool = False
    is_zero: bool = True
    broken: int | None = None
    checked: int = 0
    total: Any = 0.0
    since: int = 0
    sum: float = 0.0

    def add(self, value: Any, size: Float) -> None:
        """Count a step, by the value and the size of its derivative; the first is checked."""
        self.step, self.total = self.step + 1, self.total + value
        dr.schedule(self.total)
        if self.step == 1 or self.step - self.checked >= CHECK_EVERY:
            self.check()
        if self.step % CHECK_EVERY == 1:
            self.check_slopes(size)

    def in_unit(self, slopes: Sequence[Float], size: Float) -> list[Float]:
        """Return derivatives in the unit of the descent."""
        if self.unit is None:
            mean = float(size.numpy()[0]) / sum(map(dr.width, slopes))
            if 0 < mean < math.inf:
                self.unit = 2.0 ** min(round(math.log2(USUAL / mean)), 126)  # of single precision
        return [slope * (self.unit or 1.0) for slope in slopes]

    def check_slopes(self, size: Float) -> None:
        """Raise ValueError if derivatives are not finite, as they were not at the last check.

        The descent recovers from one such step, as of a noisy rendering, and not from all.
        """
        step, before = self.step - 1, self.broken
        self.broken = None if math.isfinite(size.numpy()[0]) else step
        if self.broken is not None and before is not None:
            raise _no_derivative(f"steps {before} and {step}")

    def check(self) -> None:
        """Raise ValueError if a value was not finite."""
        if self.step == self.checked:
            return
        total = float(np.asarray(dr.slice(self.total)).reshape(-1)[0])
        first, self.checked, self.total = self.checked, self.step, 0.0
        if not math.isfinite(total):
            if self.broken is not None:  # which made the picture so
                raise _no_derivative(f"step {self.broken}")
            steps = f"step {first}" if self.step - first == 1 else f"steps {first}-{self.step - 1}"
            raise ValueError(f"loss: its value is {total:g} at {steps}; it must be finite")
        self.is_zero &= total == 0
        self.sum += total

    def recent(self) -> float:
        """Return the mean value of the steps since the last call of this."""
        self.check()
        mean = self.sum / max(1, self.step - self.since)
        self.since, self.sum = self.step, 0.0
        return mean

    def check_use(self) -> None:
        """Raise ValueError if no step of a fit had a derivative, unless its loss was least, 0.

        One that was not finite is an error in any case.
        """
        self.check()
        if self.unit is None and self.broken is not None:
            raise _no_derivative(f"step {self.broken}")
        if self.step > 0 and self.unit is None and not (self.depends and self.is_zero):
            raise ValueError(
                "loss: its value does not depend on the picture at any step; compute it by Dr.Jit "
                "from the picture that it is given (a NumPy array has no derivative, and dr.freeze "
                "passes none on)"
            )


def _no_derivative(steps: str) -> ValueError:
    return ValueError(
        f"loss: its value is finite, but not its derivative at {steps}; dr.sqrt has none at 0: "
        "take dr.sqrt(x + 1e-8)"
    )


USUAL = 2.0**-15
"""About the mean absolute derivative of a squared error by the values of a picture of 64x64 pixels.
With 1e-10 in place of the epsilon 1e-8 of `eigengs_dr.fitting.coarse.NOISY`, Gaussians where a loss
has next to no weight disturb the others: twice the loss."""

CHECK_EVERY = 10
"""Calls after which the values are read back; each read waits for the device."""

TINY = 1e-30
"""Smallest divisor, and lower bound of a loss before its logarithm."""

PULL = 10.0
"""How strongly sums outside the bounds are pulled back: a tenth of the range outside weighs as much
as the root mean square of the derivative."""


class Slope(NamedTuple):
    """The derivative of a loss at the picture of a step, instead of a model around it.

    Attributes
    ----------
    derivative : Float, shape (pixels * channels,)
        In tile layout, times half the number of values, as `Quadratic.compare` returns it.
    size : Float, shape (1,)
        0 if there is no derivative at this step, which then moves nothing.
    """

    derivative: Float
    size: Float

    def compare(
        self, packed: Float, background: list, lists: TileLists, radius: float, pairs: bool = False
    ) -> tuple[Float, list]:
        """Return the derivative, which is given in Floats; there are no squares."""
        return self.derivative, []


@dataclass(frozen=True, eq=False)
class PictureLoss:
    """A loss of the user for the pictures that a set shows.

    Attributes
    ----------
    loss : Loss
        Of a picture, or of several maps as channels of one picture.
    shown : tuple of Channels
        What the channels of a set show.
    grid : Grid
    calls : Calls
    """

    loss: Loss
    shown: tuple[Channels, ...]
    grid: Grid
    calls: Calls = field(default_factory=Calls)

    @property
    def number(self) -> int:
        """Number of channels of a set."""
        return self.shown[-1].part.stop

    @contextmanager
    def slopes(self) -> Iterator[Callable[[State], Slope]]:
        """Give the derivative at the picture of each step, a function of its state."""
        with (
            freeze_program(self.draw) as draw,
            freeze_program(self.to_slope) as to_slope,
        ):

            def model_at(state: State) -> Slope:
                assert state.moving is not None and state.fixed is not None
                radius, background = kernel_radius(state.fixed.cutoff), state.fixed.background
                sums, pictures = draw(
                    state.moving.packed, list(background), state.lists[-1], radius
                )
                slopes, size = self.step(pictures)
                return Slope(to_slope(sums, slopes), size)

            yield model_at

    def step(self, pictures: list[Float]) -> tuple[list[Float], Float]:
        """Return the derivatives by the pictures of a step, and their size, see `derivative`.

        Parameters of the user get theirs, and step.
        """
        value, slopes, size = self.derivative(pictures, self.loss.parameters)
        if self.loss.parameters is not None:
            self.loss.parameters.step()
        self.calls.add(value, size)
        return slopes, size

    def draw(
        self, packed: Float, background: list, lists: TileLists, radius: float
    ) -> tuple[Float, list[Float]]:
        """Return the sums of a set in tile layout, and the pictures that the loss sees."""
        sums = forward(packed, background, lists, radius)
        dr.eval(sums)
        return sums, self.seen(to_tensor(sums, self.grid, self.number).array)

    def draw_set(self, gaussians: Gaussians) -> tuple[Float, list[Float]]:
        """Return the sums of a set and the pictures of the loss, see `draw`, by new lists."""
        lists = bin_gaussians(gaussians, adjoint=False)
        color = broadcast_rows(gaussians.color, gaussians)
        packed = pack_parameters([*detached_shape(gaussians), *color])
        radius, background = kernel_radius(gaussians.cutoff), list(gaussians.background)
        with dr.suspend_grad():
            return self.draw(packed, background, lists, radius)

    def seen(self, sums: Float) -> list[Float]:
        """Return the pictures that the loss sees of sums, both as rows of pixels."""
        pictures = show(self.shown, sums, self.number)
        if self.loss.bounds is None:
            return pictures
        return [dr.clip(picture, *self.loss.bounds) for picture in pictures]

    def to_slope(self, sums: Float, slopes: list[Float]) -> Float:
        """Return the derivative by sums in tile layout, see `Slope`, from those by the pictures."""
        number = self.grid.width * self.grid.height * self.number
        return self.pull_back(sums, slopes, in_tiles=True) * (0.5 * number)

    def pull_back(self, sums: Float, slopes: list[Float], in_tiles: bool = False) -> Float:
        """Return the derivative by sums, as rows of pixels or tiles, from those by the pictures."""
        with dr.resume_grad():
            traced = type(sums)(sums)
            dr.enable_grad(traced)
            rows = to_tensor(traced, self.grid, self.number).array if in_tiles else traced
            pictures = show(self.shown, rows, self.number)
            for picture, slope in zip(pictures, slopes, strict=True):
                dr.set_grad(picture, self._bounded(dr.detach(picture), slope))
            dr.enqueue(dr.ADMode.Backward, pictures)
            dr.traverse(dr.ADMode.Backward)
            return dr.grad(traced)

    def _bounded(self, picture: Float, slope: Float) -> Float:
        """Return a derivative by a picture that pulls values into the bounds, never out of them."""
        if self.loss.bounds is None:
            return slope
        low, high = self.loss.bounds
        excess = picture - dr.clip(picture, low, high)
        pull = dr.sqrt(dr.mean(dr.square(slope))) * (PULL / (high - low))
        inwards = dr.select(slope * excess >= 0, slope, 0)
        return dr.fma(pull, excess, inwards)

    def slope_of(self, gaussians: Gaussians) -> tuple[Float, Float]:
        """Return the sums of a set and the derivative by them, both in tile layout."""
        sums, pictures = self.draw_set(gaussians)
        return sums, self.pull_back(sums, self.derivative(pictures)[1], in_tiles=True)

    def derivative(
        self, pictures: list[Float], parameters: Any = None
    ) -> tuple[Float, list[Float], Float]:
        """Return the value of the loss, its derivatives by the pictures, and their size.

        The derivatives are in a unit of their own, see `Calls.unit`; the size is the sum of their
        absolute values, 0 if the loss has no derivative at this step.
        """
        value, slopes = self.differentiate(pictures, self.calls.step, parameters)
        dr.make_opaque(slopes)
        size = sum(dr.sum(dr.abs(slope)) for slope in slopes)
        return value, self.calls.in_unit(slopes, size), size

    def differentiate(
        self, pictures: Sequence[Float], step: int, parameters: Any = None
    ) -> tuple[Float, list[Float]]:
        """Return the value of the loss, and its derivatives by the pictures.

        Derivatives by parameters of the user stay in the parameters; no other array gets any. The
        function may render: if the collector freed another scene meanwhile, the process might end.
        """
        with dr.resume_grad(), collector_off():
            leaves = self._leaves(pictures)
            called = _call(self.loss.function, self._named(leaves), step)
            value = _to_array(called, type(pictures[0]))
            dr.clear_grad(leaves)  # of what the function has differentiated itself
            if dr.grad_enabled(value):
                self.calls.depends = True
                dr.set_grad(value, 1)
                # Forward from here marks what depends on these; backward then visits nothing else.
                marked = [*leaves, *(parameters.values() if parameters is not None else ())]
                dr.enqueue(dr.ADMode.Forward, marked)
                dr.traverse(dr.ADMode.Backward)
            return dr.detach(value), [dr.grad(leaf).array for leaf in leaves]

    def judged(self, gaussians: Gaussians) -> dict[str, float]:
        """Return the loss of a set for its row, see `Loss.judge`; and its margin to a target."""
        self.calls.check()
        loss = self.judge(self.draw_set(gaussians)[1])
        if self.loss.target is None:
            return {"loss": loss}
        return {"loss": loss, "margin": 10 * math.log10(self.loss.target / max(loss, TINY))}

    def merit(self, row: Record) -> float:
        """Return the figure of a row that is largest for the best set: minus its loss.

        The last set is the best if losses are not comparable: with parameters, which are those of
        the last step; or with neither an image nor a judge, where steps may see other cameras.
        """
        if self.loss.parameters is not None or not self.compares:
            return float(row["iteration"])
        return -float(row["loss"])

    @property
    def compares(self) -> bool:
        """Whether losses of two sets say which is better, as those of other cameras do not."""
        return self.loss.judge is not None or bool(self.shown[0].targets)

    @property
    def is_called_by_row(self) -> bool:
        """Whether a row of the trace before the last calls the loss, see `Calls.recent`."""
        is_new = self.calls.step == self.calls.since  # no step to take the mean of
        return self.compares or self.loss.target is not None or is_new

    def judge(self, pictures: Sequence[Float]) -> float:
        """Return the value by which pictures, as rows of pixels, are compared."""
        function, judge = self.loss.function, self.loss.judge
        with dr.resume_grad(), collector_off():  # the function may differentiate, as in a step
            picture = self._named(self._leaves(pictures))
            if judge is None:
                value = _call(function, picture, 0)
            else:
                value = _call(judge, dr.detach(picture))
        number = _one_number(value)
        if not math.isfinite(number):
            name = "its value" if judge is None else "the judge"
            raise ValueError(f"loss: {name} is {number:g} for a picture; it must be finite")
        return number

    def _leaves(self, pictures: Sequence[Float]) -> list[Tensor]:
        """Return pictures, rows of pixels, as tensors with derivatives of their own."""
        height, width = self.grid.height, self.grid.width
        leaves = [
            types_of(rows).Tensor(rows, (height, width, channels.number))
            for channels, rows in zip(self.shown, pictures, strict=True)
        ]
        dr.enable_grad(leaves)
        return leaves

    def _named(self, pictures: Sequence[Tensor]) -> Any:
        if not self.shown[0].name:
            return pictures[0]
        return {_Name(c.name): p for c, p in zip(self.shown, pictures, strict=True)}


class _Name(str):
    """The name of a map as a key of what a loss is given.

    Dr.Jit 1.5 reduces a dict by its keys, and these by their letters, which are text again, until
    the process ends.
    """

    __slots__ = ()

    def __iter__(self) -> Iterator[str]:
        raise TypeError(
            "loss: its pictures are a dict, which Dr.Jit does not reduce; take each by its name, "
            f"such as pictures[{str(self)!r}]"
        )
        yield ""  # so that the error comes with the first letter, where Dr.Jit passes it on


def _call(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function of the user, which may end the fit from an operation of Dr.Jit too."""
    try:
        return function(*arguments)
    except RuntimeError as error:
        if isinstance(error.__cause__, KeyboardInterrupt):  # Dr.Jit wraps exceptions
            raise KeyboardInterrupt from error
        raise


def _to_array(value: Any, kind: type[Float]) -> Float:
    """Return the value of a loss as an array of one entry.

    Raises
    ------
    ValueError
        If it is none.
    """
    if isinstance(value, (int, float)):
        return kind(value)
    if not dr.is_array_v(value) or not dr.is_float_v(value):
        raise ValueError(f"loss: it returned {type(value).__name__}; return a number of Dr.Jit")
    if dr.is_tensor_v(value):
        value = value.array
    if dr.width(value) != 1 or dr.depth_v(value) != 1:
        raise _too_many(value.shape)
    return kind(value)


def _one_number(value: Any) -> float:
    """Return a number of Python, NumPy, PyTorch or Dr.Jit, or an array of one, as a float.

    Raises
    ------
    ValueError
        If it is none.
    """
    shape = getattr(value, "shape", ())
    if math.prod(shape) != 1:
        raise _too_many(shape)
    array = np.asarray(dr.detach(value)) if dr.is_array_v(value) else value
    number = array.item() if hasattr(array, "item") else array
    if not isinstance(number, (int, float)):
        raise ValueError(f"loss: it returned {type(value).__name__}; return a number")
    return float(number)


def _too_many(shape: Sequence[int]) -> ValueError:
    return ValueError(
        f"loss: it returned an array of shape {tuple(shape)}; return one number, such as "
        "dr.mean(x, axis=None)"
    )
