"""Workers: the interface of a pool, and the pool of this machine's processes."""
