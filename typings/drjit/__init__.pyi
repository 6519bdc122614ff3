"""Dr.Jit as the checks of this repository see it: its functions take and return anything.

Dr.Jit's own stubs, which users have, describe one type for each backend and precision, but the
package serves all of them by the same code.
"""

from typing import Any

from numpy.typing import NDArray

class AnyArray:
    """What all arrays have."""

    index: int
    state: object
    shape: tuple[int, ...]

    def __init__(self, *values: object) -> None: ...
    def __len__(self) -> int: ...
    def __eq__(self, other: object) -> bool: ...
    def numpy(self) -> NDArray[Any]:
        """Return a copy or a view."""

def __getattr__(name: str) -> Any: ...
