"""Speed of reflectance laws beside the exponential alone, and of whole disks; prints JSON.

Run with ``OMP_NUM_THREADS=1 python benchmarks/reflectance.py``. CPU time for each ray, least of several runs, in
batches as large as a render hands over.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from giantlike.ray_tracing import (
    Akimov,
    Hapke,
    Lambert,
    LommelSeeliger,
    LunarLambert,
    McEwen,
    Minnaert,
    OrenNayar,
    Reflectance,
    disk_integrated,
)
from giantlike.ray_tracing.disk import disk_photocenter

RAYS = 40_000
RUNS = 15
LAWS: dict[str, Reflectance] = {
    "lambert": Lambert(),
    "lommel_seeliger": LommelSeeliger(),
    "mcewen": McEwen(),
    "lunar_lambert": LunarLambert(),
    "minnaert": Minnaert(k=0.6),
    "akimov": Akimov(),
    "oren_nayar": OrenNayar(sigma_deg=20.0),
    "hapke_smooth": Hapke(w=0.1, b0=1.0, h=0.05, hg1=-0.3),
    "hapke_rough": Hapke(w=0.1, b0=1.0, h=0.05, hg1=-0.3, theta_bar_deg=20.0),
}


def nanoseconds(function: Callable[[], Any], count: int, *, repeats: int = 10) -> float:
    best = np.inf
    for _ in range(RUNS):
        start = time.process_time()
        for _ in range(repeats):
            function()
        best = min(best, time.process_time() - start)
    return round(1e9 * best / repeats / count, 2)


def main() -> None:
    random = np.random.default_rng(1)
    mu0, mu = random.uniform(0.01, 1.0, size=(2, RAYS))
    phase = random.uniform(1.0, 1.1, size=RAYS)
    phases = np.radians(np.linspace(0.0, 150.0, 6))
    report = {
        "ns_per_ray": {"exp": nanoseconds(partial(np.exp, -phase), RAYS)}
        | {name: nanoseconds(partial(law, mu0, mu, phase), RAYS) for name, law in LAWS.items()},
        "ms_per_disk": {
            name: round(1e-6 * nanoseconds(partial(disk_integrated, law, phases), phases.size, repeats=1), 2)
            for name, law in LAWS.items()
        },
        "photocenter_of_300_px": {
            name: [round(150.0 * float(offset), 2) for offset in disk_photocenter(law, phases)]
            for name, law in LAWS.items()
        },
    }
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
