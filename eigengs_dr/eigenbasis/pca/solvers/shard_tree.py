"""The fixed tree in which the states of shards are merged."""

from __future__ import annotations

Node = tuple[int, int]
"""A range of shards, from the first to the last, without the last."""


def tree_levels(count: int) -> list[list[Node]]:
    """Return the tree over some shards: neighbours join; an odd last one goes up alone.

    Parameters
    ----------
    count : int
        Number of shards.

    Returns
    -------
    list of list of (int, int)
        The nodes of each level: first the shards, last the root.
    """
    level = [(k, k + 1) for k in range(count)]
    levels = [level]
    while len(level) > 1:
        level = [
            (pair[0][0], pair[-1][1])
            for pair in (level[k : k + 2] for k in range(0, len(level), 2))
        ]
        levels.append(level)
    return levels


def holds(node: Node, other: Node) -> bool:
    """Whether all shards of another node belong to a node."""
    return node[0] <= other[0] and other[1] <= node[1]
