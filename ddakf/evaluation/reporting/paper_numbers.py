"""Numbers of the paper's Tables 1 to 7, with its decimals: means with standard deviations, and p-values.

They were measured on data and with implementations that are not public, and appear beside ours, never mixed with them.
"""

from __future__ import annotations

import re

METHODS = ("kf", "icp", "pf", "clothfit", "opt-ed", "ddakf")  # in the order of the paper's columns


def _pairs(text: str) -> dict[str, str]:
    values = (re.sub(r"(?<!\d)\.", "0.", part).split() for part in text.split(","))
    return {method: f"{mean} ± {sd}" for method, (mean, sd) in zip(METHODS, values, strict=True)}


def _p(text: str) -> dict[str, str]:
    return dict(zip(METHODS, (part.strip() for part in text.split(",")), strict=False))


FAUST = {
    "rmse_mm": _pairs("8.40 .50, 7.80 .60, 7.30 .70, 6.90 .50, 6.60 .48, 6.35 .42"),
    "hausdorff_mm": _pairs("26.0 2.0, 24.0 2.0, 22.0 1.7, 20.8 1.6, 20.1 1.5, 19.4 1.4"),
    "acceleration_variance": _pairs("1.35 .10, 1.20 .09, 1.10 .08, .95 .08, 1.15 .10, .92 .08"),
}
FAUST_P = {
    "rmse_mm": _p("< 0.001, 0.006, 0.031, 0.028, 0.048"),
    "hausdorff_mm": _p("< 0.001, 0.004, 0.040, 0.021, 0.061 (n.s.)"),
    "acceleration_variance": _p("< 0.001, 0.008, 0.047, 0.051, 0.015"),
}
CLOTH3D = {
    "rmse_mm": _pairs("9.50 .80, 8.90 .70, 8.40 .80, 7.80 .60, 7.55 .58, 7.25 .62"),
    "iou": _pairs(".88 .01, .89 .01, .90 .01, .90 .01, .91 .01, .92 .02"),
    "stretch_percent": _pairs("4.50 .30, 4.10 .30, 3.60 .30, 3.40 .30, 3.25 .28, 2.95 .32"),
    "bend_deg": _pairs("4.50 .50, 4.20 .50, 3.70 .50, 3.60 .40, 3.40 .42, 3.20 .45"),
    "penetration_mm": _pairs("1.60 .15, 1.40 .14, 1.20 .12, 1.00 .10, 1.10 .12, .78 .10"),
    "acceleration_variance": _pairs("1.30 .11, 1.18 .10, 1.05 .09, .92 .08, 1.08 .09, .85 .08"),
}
CLOTH3D_P = {
    "rmse_mm": _p("< 0.001, 0.004, 0.015, 0.030, 0.046"),
    "iou": _p("< 0.001, 0.002, 0.011, 0.028, 0.041"),
    "stretch_percent": _p("< 0.001, < 0.001, 0.009, 0.022, 0.052 (n.s.)"),
    "bend_deg": _p("< 0.001, 0.006, 0.017, 0.041, 0.060 (n.s.)"),
    "penetration_mm": _p("< 0.001, < 0.001, 0.004, 0.019, 0.015"),
    "acceleration_variance": _p("< 0.001, 0.003, 0.014, 0.033, 0.008"),
}
NOISE = {  # RMSE, mm, by the noise in mm
    0: _pairs("9.6 .35, 9.0 .33, 8.5 .36, 7.3 .28, 6.9 .27, 6.6 .25"),
    1: _pairs("9.9 .38, 9.4 .36, 8.8 .39, 7.6 .31, 7.4 .30, 6.9 .27"),
    3: _pairs("10.8 .45, 10.4 .43, 9.9 .48, 8.6 .37, 8.9 .40, 8.1 .34"),
    5: _pairs("11.8 .52, 11.2 .49, 10.9 .55, 9.3 .42, 10.2 .50, 8.8 .39"),
}
DROP = {  # penetration, mm, by the missing points in per cent
    0: _pairs("1.60 .10, 1.40 .09, 1.20 .08, 1.00 .07, 1.10 .08, .78 .06"),
    10: _pairs("1.78 .11, 1.56 .10, 1.32 .09, 1.12 .08, 1.25 .09, .85 .07"),
    20: _pairs("1.98 .13, 1.74 .11, 1.46 .10, 1.25 .09, 1.45 .11, .98 .08"),
    30: _pairs("2.22 .15, 1.95 .13, 1.65 .12, 1.41 .10, 1.80 .14, 1.15 .10"),
    40: _pairs("2.48 .17, 2.20 .15, 1.88 .14, 1.59 .12, 2.15 .18, 1.35 .12"),
}
RELIABILITY = {"rmse": 0.62, "penetration": 0.65}  # Spearman's rho of the score s_k
