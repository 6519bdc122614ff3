"""For tests that another change removes; the others import `_helpers`."""

from _helpers.families import *  # noqa: F403
from _helpers.sets import *  # noqa: F403
