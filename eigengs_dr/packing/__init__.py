"""Few bytes: rounding within an allowed loss.

- ``pack``: `pack`, and what it compares
- ``rounding``: the largest steps within a loss, and rounding with error feedback
"""
