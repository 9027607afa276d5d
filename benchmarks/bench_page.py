"""Time until the bench shows a run of many images in a headless Chromium; prints JSON.

``python benchmarks/bench_page.py RUN --images 1000`` copies a finished run, makes it that large, and opens it.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.viewer.browser import chromium_page, multiply, open_page, served

_REPEATS = 3


def main() -> None:
    """Open the page some times and print the least time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--images", type=int, default=1000)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        run = Path(shutil.copytree(arguments.run, Path(folder) / "run"))
        multiply(run, arguments.images)
        with served(run) as address:
            spent = []
            for _ in range(_REPEATS):
                with chromium_page() as page:
                    spent.append(open_page(page, address))
    print(json.dumps({"images": arguments.images, "open_ms": min(spent), "all_ms": spent}))


if __name__ == "__main__":
    main()
