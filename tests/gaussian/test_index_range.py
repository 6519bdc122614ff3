"""Images too large for 32-bit indices are refused, without allocating them."""

import pytest

from eigengs_dr.gaussian.file import check_index_range


def test_sizes_within_the_limit_pass():
    for size in ((37837, 37837, 3), (8191, 8192, 64), (65536, 65535, 1), (8189, 8192, 64)):
        check_index_range(*size)


@pytest.mark.parametrize("size", [(37838, 37838, 3), (8192, 8192, 64), (65536, 65536, 1)])
def test_larger_sizes_are_refused_in_one_line(size):
    with pytest.raises(ValueError, match=r"has [\d,]+ values, the limit is 4,294,967,295") as found:
        check_index_range(*size)
    message = str(found.value)
    assert f"{size[0]}x{size[1]} pixels and {size[2]} channels" in message
    assert "scale it down" in message and "\n" not in message
    with pytest.raises(ValueError, match="has 4,294,967,296 values"):  # in whole tiles
        check_index_range(8189, 8192, 64, tile=(4, 4))
