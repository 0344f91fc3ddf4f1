"""Studies: what they are asked for, their plans, what is computed of each cell, and where it is kept."""
