"""A replay of a flight system's paper with several seeds: which agreements hold, and which are luck of the draw.

    python examples/replay_seeds.py artemis1 --seeds 3 --small

For each comparison: the paper's value, ours by seed, and how often they agree. ``giantlike replay NAME`` does one seed,
with figures.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from giantlike.missions import REPLAYS, Comparison, ReplaySettings, run_replay


def comparisons(name: str, folder: Path, seed: int, *, small: bool) -> list[Comparison]:
    """All comparisons of a replay, in the order of the paper."""
    replayed = run_replay(name, ReplaySettings(output=folder / str(seed), seed=seed, small=small))
    return [each for section in replayed.sections for each in section.comparisons]


def told(value: object) -> str:
    """A number to four digits, or a text as it is."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("name", choices=list(REPLAYS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--small", action="store_true", help="fewer images and draws")
    parser.add_argument("--output", type=Path, default=Path("replay-seeds"))
    given = parser.parse_args()
    runs = [comparisons(given.name, given.output, seed + 1, small=given.small) for seed in range(given.seeds)]
    for same in zip(*runs, strict=True):
        agreed, first = sum(each.agrees is True for each in same), same[0]
        ours = ", ".join(told(each.ours) for each in same)
        print(f"{first.reference:10} {first.kind:12} {agreed}/{len(same)}  {first.what}: {told(first.paper)}; {ours}")


if __name__ == "__main__":
    main()
