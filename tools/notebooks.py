"""Run notebooks from top to bottom and keep their outputs, without times; a film goes to docs/, too.

python tools/notebooks.py notebooks/1_stiffness_sweep.ipynb
"""

import base64
import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

for path in map(Path, sys.argv[1:]):
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(notebook, timeout=None, record_timing=False, resources={"metadata": {"path": path.parent}})
    client.execute()
    nbformat.write(notebook, path)
    for output in [output for cell in notebook.cells for output in cell.get("outputs", ())]:
        if film := output.get("data", {}).get("image/gif"):
            (Path(__file__).parents[1] / "docs" / f"film_{path.stem}.gif").write_bytes(base64.b64decode(film))
