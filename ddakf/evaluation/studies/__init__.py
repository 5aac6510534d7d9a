"""Studies: grids of trials over sequences, views, systems and seeds, run once and summed up with statistics."""
