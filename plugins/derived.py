"""What a texture computes from its parameters, one operation of the graph of derivatives.

`mitsuba.render` differentiates the renderer as one operation whose inputs are the parameters. In
forward mode, the derivatives of all that textures have computed from them must be known by then.
Dr.Jit walks from the parameters to the operations in the order in which these were made. So one
operation, made before the rendering, must lead from the parameters to all that lookups read: of a
chain of several, only the first would come before the renderer, and the derivative be 0.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr

Arrays = dict[str, Any]


def derived(inputs: Arrays, compute: Callable[[Arrays], Arrays]) -> Arrays:
    """Return ``compute(inputs)``; derivatives flow through one operation, in both modes.

    Parameters
    ----------
    inputs : dict of str to TensorXf
    compute : callable
        Returns a dict of arrays.
    """
    if not dr.grad_enabled(inputs):
        return compute(inputs)
    return dr.custom(_Derived, inputs, compute)


class _Derived(dr.CustomOp):
    """The operation of `derived`: it keeps the graph of its own and walks it in both modes."""

    def eval(self, inputs: Arrays, compute: Callable[[Arrays], Arrays]) -> Arrays:
        """Compute the arrays; `inputs` come without their derivatives."""
        self.inputs = {name: type(value)(value) for name, value in inputs.items()}
        with dr.resume_grad():
            dr.enable_grad(self.inputs)
            self.outputs = compute(self.inputs)
        return dr.detach(self.outputs)

    def forward(self) -> None:
        """Push the derivatives of the parameters through the graph."""
        if "values" in self.outputs:  # loops of a pyramid, which Dr.Jit 1.5 walks backward only
            raise RuntimeError(
                "gaussian_texture: no forward mode with a prefilter; use drjit.backward, or "
                "prefilter = 0"
            )
        dr.set_grad(self.inputs, self.grad_in("inputs"))
        self.set_grad_out(self._walk(dr.ADMode.Forward, self.inputs, self.outputs))

    def backward(self) -> None:
        """Pull the derivatives of the results back."""
        dr.set_grad(self.outputs, self.grad_out())
        self.set_grad_in("inputs", self._walk(dr.ADMode.Backward, self.outputs, self.inputs))

    def _walk(self, mode: Any, source: Arrays, target: Arrays) -> Arrays:
        dr.enqueue(mode, source)
        dr.traverse(mode, dr.ADFlag.ClearInterior | dr.ADFlag.ClearInput)
        found = dr.grad(target)
        dr.clear_grad(target)
        return found

    def name(self) -> str:
        """Return the name for graphs of Dr.Jit."""
        return "gaussian_texture"
