"""The site and a study's report as a browser shows them, at the width of a phone and of a laptop, light and dark."""

import functools
import http.server
import json
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pytest

from tests.processes import ROOT

NAMES: Final = "chromium", "chromium-browser", "google-chrome", "google-chrome-stable"
BROWSER: Final = next(filter(None, map(shutil.which, NAMES)), None)
WIDTHS: Final = 390, 1280
HARNESS: Final = ROOT / "tests" / "data" / "browser.html"
"""A page that opens others at some widths, and measures what is wrong with them."""


class Silent(http.server.SimpleHTTPRequestHandler):
    """Serves a folder."""

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""


FAULTY: Final = """<!doctype html><link rel="icon" href="data:,"><body style="background: white">
<p style="width: 2000px">wide</p><pre style="overflow: hidden; width: 50px">far too long to be seen</pre>
<img src="data:,"><p style="color: #ccc">faint</p><script>console.error("a fault of its own")</script>"""
"""A page with each of the faults, which must be found."""


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, list[str]]]:
    """Address and paths of all pages of the site, and of the reports of two studies."""
    if BROWSER is None:
        pytest.skip(f"NOT TESTED in a browser: there is none of {', '.join(NAMES)}")
    folder = tmp_path_factory.mktemp("browser")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    run = functools.partial(subprocess.run, check=True, capture_output=True, cwd=folder, env=environment)
    run([sys.executable, "-m", "tools.site"], cwd=ROOT)
    shutil.copytree(ROOT / "build" / "site", folder, dirs_exist_ok=True)
    common = "sweep momentum_transfer --samples 20 --reference-samples 20"
    for name, more in {
        "small": "--contact penalty --stiffness 1e3",
        "large": "--contact penalty,mujoco --stiffness 1e3:1e5:4:log --sigma 0.05,0.1 --seeds 2",
    }.items():
        run([sys.executable, "-m", "mjx_study", *common.split(), *more.split(), "--output", name])
        run([sys.executable, "-m", "mjx_study", "report", name])
    (folder / "faulty.html").write_text(FAULTY)
    paths = [str(path.relative_to(folder)) for path in sorted(folder.rglob("*.html"))]
    script = HARNESS.read_text().replace("PATHS", json.dumps(paths)).replace("WIDTHS", json.dumps(WIDTHS))
    (folder / "harness.html").write_text(script)
    handler = functools.partial(Silent, directory=str(folder))
    with http.server.ThreadingHTTPServer(("localhost", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://localhost:{server.server_port}", paths
        server.shutdown()


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_pages_are_whole_and_readable(pages: tuple[str, list[str]], dark: bool, tmp_path: Path) -> None:
    address, paths = pages
    assert BROWSER is not None and {"index.html", "small/report.html", "large/report.html"} <= {*paths}
    options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--user-data-dir={tmp_path}"]
    options += ["--virtual-time-budget=600000", "--enable-logging=stderr", "--window-size=1400,1000"]
    scheme = f"--blink-settings=preferredColorScheme={0 if dark else 1}"
    command = [BROWSER, *options, scheme, "--dump-dom", f"{address}/harness.html"]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert (results := re.search(r'<pre id="results">(.*?)</pre>', shown.stdout, re.DOTALL)), shown.stderr[-2000:]
    found: dict[str, Any] = json.loads(results[1].replace("&amp;", "&").replace("&lt;", "<").replace("&gt;", ">"))
    assert len(found) == len(paths) * len(WIDTHS) and all(page["parts"] > 2 for page in found.values())
    kinds = "wide", "cut", "broken", "unnamed", "faint"
    faults: dict[str, Any] = {page: {name: each[name] for name in kinds if each[name]} for page, each in found.items()}
    faults = {page: wrong for page, wrong in faults.items() if wrong}
    for width in WIDTHS:
        page = f"faulty.html at {width}"
        assert list(faults.pop(page)) == [*kinds] and not found.pop(page)["dark"]
    faults |= {page: "not dark" if dark else "dark" for page, each in found.items() if each["dark"] != dark}
    faults |= {page: "first code block cut" for page in found if page.startswith("index.") and found[page]["first"] > 0}
    assert not faults, json.dumps(faults, indent=1)
    said = re.findall(r"CONSOLE.*", shown.stderr)
    assert len(said) == len(WIDTHS) and all("a fault of its own" in each for each in said), said
