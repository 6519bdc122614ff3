"""What the package needs of `drjit.detail`: if a test fails, what it names has to be mended."""

import drjit as dr

from eigengs_dr.backend.arrays import indices_of, new_scope, scope, types_in
from eigengs_dr.backend.selection import select


def test_scopes_are_numbered(backend):
    """`record` begins one after a replay, or programs after it are compiled twice; a texture uses
    a lookup again only within one, or it could belong to a branch that has ended."""
    kind = dr.backend_v(select(backend).Float)
    before = scope(kind)
    assert scope(kind) == before
    new_scope(kind)
    assert scope(kind) != before


def test_variables_have_numbers(backend):
    """A texture knows by them that it is asked twice for the same points."""
    types = types_in(select(backend))
    one, other = types.Float(1, 2), types.Float2([3, 4], [5, 6])
    numbers = indices_of([one, other])
    assert len(set(numbers)) == 3 and numbers == indices_of([one, other])
    assert indices_of([types.Float(1, 2)]) != indices_of([one])
