"""Rank statistics: Spearman's correlation, and the area under the receiver operating characteristic."""

from __future__ import annotations

import numpy as np


def spearman(a: np.ndarray, b: np.ndarray) -> float:
    """Rank correlation: Pearson's of the ranks, ties sharing their mean rank; NaN when one of them is constant."""
    from scipy.stats import rankdata

    ranks = rankdata(a), rankdata(b)
    a, b = (rank - rank.mean() for rank in ranks)
    scale = np.sqrt((a**2).sum() * (b**2).sum())
    return float((a * b).sum() / scale) if scale > 0 else float("nan")


def roc_auc(score: np.ndarray, positive: np.ndarray) -> float:
    """Area under the receiver operating characteristic: the probability that a positive has the higher score than a
    negative, ties counting half (Mann and Whitney 1947).

    Args:
        score: (n,) high where a positive is expected: for a reliability, which is high when all is well, pass its negative.
        positive: (n,) bool.

    Returns:
        0.5 for a score without information; NaN with only positives or only negatives.
    """
    from scipy.stats import rankdata

    positive = np.asarray(positive, bool)
    n, m = int(positive.sum()), int((~positive).sum())
    if n == 0 or m == 0:
        return float("nan")
    return float((rankdata(score)[positive].sum() - n * (n + 1) / 2) / (n * m))
