"""The folder of a study: its manifest, cells and labelled arrays."""
