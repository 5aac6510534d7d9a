"""Segmentation by colour: histograms of the garment's colours and of other things', and their ratio at each point."""

from numba import njit

CELLS = (32, 32, 6)  # of log red/green, of log blue/green, and of the mean logarithm, which shading changes
WIDTHS = (0.05, 0.05, 0.5)  # of a cell, natural logarithm
FIRST = (-0.8, -0.8, 2.75)  # where the first cells begin: black has a logarithm of 2.77, white of 5.6


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def cell_of(colors, i, table):
    """Cell of a point's colour along the three axes; the outermost extend without end."""
    red, green, blue = table[colors[i, 0]], table[colors[i, 1]], table[colors[i, 2]]
    u = int((red - green - FIRST[0]) / WIDTHS[0])
    v = int((blue - green - FIRST[1]) / WIDTHS[1])
    w = int(((red + green + blue) / 3.0 - FIRST[2]) / WIDTHS[2])
    return min(max(u, 0), CELLS[0] - 1), min(max(v, 0), CELLS[1] - 1), min(max(w, 0), CELLS[2] - 1)


@njit(nogil=True, cache=True, error_model="numpy")
def add_colors(colors, chosen, table, counts):
    """Adds the chosen points to a histogram, each over the cells around its own, as the noise of a camera spreads colours.

    Args:
        colors: (N, 3) uint8.
        chosen: (N,) bool.
        table: (256,) float32, logarithm of each value.
        counts: CELLS float32, in and out.
    """
    for i in range(colors.shape[0]):
        if chosen[i]:
            u, v, w = cell_of(colors, i, table)
            for a in range(-1, 2):
                for b in range(-1, 2):
                    for c in range(-1, 2):
                        share = 1.0 / (1 << (3 + abs(a) + abs(b) + abs(c)))  # 1/4, 1/2, 1/4 along each axis
                        at = min(max(u + a, 0), CELLS[0] - 1), min(max(v + b, 0), CELLS[1] - 1), min(max(w + c, 0), CELLS[2] - 1)
                        counts[at] += share


@njit(nogil=True, cache=True, error_model="numpy")
def mark_others(colors, table, likelihoods, ratio, other):
    """Marks the points whose colours are ``ratio`` times as likely among other things as on the garment.

    Args:
        colors: (N, 3) uint8.
        table: (256,) float32, logarithm of each value.
        likelihoods: (2, *CELLS) float32, of the garment's colours and of others.
        ratio: of likelihoods.
        other: (N,) bool out.
    """
    for i in range(colors.shape[0]):
        u, v, w = cell_of(colors, i, table)
        other[i] = likelihoods[1, u, v, w] > ratio * likelihoods[0, u, v, w]
