"""Worker processes: an interface of a pool, and the processes of this machine that implement it."""
