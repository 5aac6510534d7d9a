"""Budget of a frame: its clock, the costs that it learns, the work that fits, and what is left out."""
