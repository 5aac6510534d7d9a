/** Prometheus text format: the samples of `/metrics`, and quantiles of its histograms. */

/** Samples by metric name; the labels of each as written, `name="value"` by name. */
export class Exposition {
  private readonly samples = new Map<string, { labels: Map<string, string>; value: number }[]>();

  constructor(text: string) {
    for (const line of text.split("\n")) {
      const found = /^([a-zA-Z_:][\w:]*)(?:\{(.*)\})? (\S+)/.exec(line);
      if (!found) continue; // a comment
      const labels = new Map<string, string>();
      for (const [, name, value] of (found[2] ?? "").matchAll(/(\w+)="((?:[^"\\]|\\.)*)"/g)) labels.set(name!, value!);
      const sample = { labels, value: found[3] === "+Inf" ? Infinity : Number(found[3]) };
      const others = this.samples.get(found[1]!);
      if (others) others.push(sample);
      else this.samples.set(found[1]!, [sample]);
    }
  }

  /** Sum of the samples with these labels; NaN: none. */
  sum(name: string, labels: Record<string, string> = {}): number {
    const matching = (this.samples.get(name) ?? []).filter((s) =>
      Object.entries(labels).every(([k, v]) => s.labels.get(k) === v),
    );
    return matching.length > 0 ? matching.reduce((sum, { value }) => sum + value, 0) : NaN;
  }

  /** Values of a metric by one of its labels, summed over the others. */
  by(name: string, label: string): Map<string, number> {
    const sums = new Map<string, number>();
    for (const { labels, value } of this.samples.get(name) ?? []) {
      const key = labels.get(label) ?? "";
      sums.set(key, (sums.get(key) ?? 0) + value);
    }
    return sums;
  }

  /** Counts of a histogram by the upper bounds of its buckets, cumulative, bounds rising. */
  buckets(name: string): [number, number][] {
    const counts = [...this.by(`${name}_bucket`, "le")].map(([bound, count]): [number, number] => [
      bound === "+Inf" ? Infinity : Number(bound),
      count,
    ]);
    return counts.sort((a, b) => a[0] - b[0]);
  }
}

/** The q-quantile of what a histogram has counted since an earlier state of it, linear within buckets; NaN: nothing. */
export function quantile(q: number, now: [number, number][], before: [number, number][] = []): number {
  const earlier = new Map(before);
  const counts = now.map(([bound, count]): [number, number] => [bound, count - (earlier.get(bound) ?? 0)]);
  const total = counts.at(-1)?.[1] ?? 0;
  if (total <= 0) return NaN;
  let [low, below] = [0, 0];
  for (const [bound, count] of counts) {
    if (count >= q * total)
      return bound === Infinity ? low : low + ((bound - low) * (q * total - below)) / Math.max(count - below, 1);
    [low, below] = [bound, count];
  }
  return low;
}
