"""Run notebooks from top to bottom and keep their outputs, without times.

python tools/notebooks.py notebooks/1_stiffness_sweep.ipynb
"""

import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

for path in map(Path, sys.argv[1:]):
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(notebook, timeout=None, record_timing=False, resources={"metadata": {"path": path.parent}})
    client.execute()
    nbformat.write(notebook, path)
