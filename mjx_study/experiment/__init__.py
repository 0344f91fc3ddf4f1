"""Studies: configuration, plan, and the numbers of a cell for each kind of study."""
