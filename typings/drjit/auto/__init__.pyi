"""Arrays of the backend that was chosen, see `drjit.auto.ad`."""

from typing import Any

def __getattr__(name: str) -> Any: ...
