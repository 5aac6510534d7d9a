/** Ellipsoid of a covariance: the region that holds the true position with a probability of 90 %. */

/** Square root of the 90 % quantile of the chi-square distribution with three degrees of freedom. */
export const RADIUS_90 = 2.5003;

/**
 * Column-major 3x3 matrix that maps the unit sphere to the ellipsoid: 2.5 times the Cholesky factor of the covariance.
 *
 * @param upper xx xy xz yy yz zz, square metres, positive definite.
 */
export function ellipsoid90(upper: ArrayLike<number>): number[] {
  const [xx, xy, xz, yy, yz, zz] = Array.from(upper) as [number, number, number, number, number, number];
  const a = Math.sqrt(Math.max(xx, 1e-12));
  const [b, c] = [xy / a, xz / a];
  const d = Math.sqrt(Math.max(yy - b * b, 1e-12));
  const e = (yz - b * c) / d;
  const f = Math.sqrt(Math.max(zz - c * c - e * e, 1e-12));
  return [a, b, c, 0, d, e, 0, 0, f].map((value) => RADIUS_90 * value);
}
