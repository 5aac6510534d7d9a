"""Studies: grids of trials over sequences, views, systems and seeds, run once, kept as rows, and summed up with statistics.

``plan`` says what is to be run and refuses what cannot be, ``journal`` keeps what has been run, ``execute`` runs what is
missing in the processes of ``workers``, ``results`` sums up, ``paper`` lists the studies that the paper's tables need, and
``command`` is ``ddakf evaluate``.
"""
