"""Cold start: seconds of ``import ddakf`` and of the first tracked frame, as JSON; ``python benchmarks/cold.py POINTS``."""

import json
import resource
import sys
import time

begun = time.perf_counter()
import ddakf  # noqa: E402, F401  the import is what is measured

imported = time.perf_counter()

import inputs  # noqa: E402

from ddakf import data  # noqa: E402


def main() -> None:
    run = inputs.run_of(data.sample(), 1, "full", int(sys.argv[1]))
    _, cloud, how = next(run.frames())
    before = time.perf_counter()
    run.tracker().step(cloud.points, **how)
    frame = time.perf_counter() - before
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    loading = imported - begun
    print(json.dumps({"import_s": loading, "first_frame_s": frame, "together_s": loading + frame, "peak_mib": peak}))


if __name__ == "__main__":
    main()
