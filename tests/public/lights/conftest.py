"""The variant of Mitsuba that tests of scenes run in."""

from _helpers.variants import skip_without_optix as pytest_pyfunc_call  # noqa: F401
from _helpers.variants import variant  # noqa: F401
