"""Studies: configuration, planning, computation of cells, and storage."""
