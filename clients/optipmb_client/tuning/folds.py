"""Which sequences are left out together, so that parameters are judged by sequences that they were not chosen on."""

from collections.abc import Sequence

__all__ = ["deal"]


def deal(weights: Sequence[int], folds: int) -> list[tuple[int, ...]]:
    """Return groups of sequences that weigh about the same; those without weight are in none.

    Args:
        weights: of the sequences, such as their number of truth boxes.
        folds: how many groups; fewer when fewer sequences have any weight, and none when only one has.

    """
    heavy = sorted((i for i, weight in enumerate(weights) if weight), key=lambda i: (-weights[i], i))
    count = min(folds, len(heavy))
    if count < 2:  # noqa: PLR2004  what is left out must leave something
        return []
    groups: list[list[int]] = [[] for _ in range(count)]
    for i in heavy:
        min(groups, key=lambda group: sum(weights[j] for j in group)).append(i)
    return [tuple(sorted(group)) for group in groups]
