"""Structure of FITS files: the sizes that the headers declare, against that of the file."""

from __future__ import annotations

import re
from mmap import mmap

import numpy as np

from giantlike._system.reading import check

_BLOCK, _CARD = 2880, 80  # bytes: FITS Standard 4.0, sections 3.1 and 4.1
_MOST_AXES = 999  # FITS standard 4.0, section 4.4.1.1


def require_whole_fits(data: bytes | mmap) -> None:
    """Walk over the HDUs and refuse a file that ends inside one of them."""
    offset, index = 0, 0
    while offset < len(data) and (index == 0 or data[offset : offset + 8] == b"XTENSION"):
        sizes: dict[str, int] = {}
        ended = False
        while not ended:
            check(offset + _BLOCK <= len(data), f"the FITS file is truncated: it ends in the header of HDU {index}")
            block = data[offset : offset + _BLOCK].decode("latin-1")
            offset += _BLOCK
            for card in (block[k : k + _CARD] for k in range(0, _BLOCK, _CARD)):
                ended = ended or card.rstrip() == "END"
                key = card[:8].rstrip()
                if not ended and re.fullmatch(r"BITPIX|NAXIS\d*|PCOUNT|GCOUNT", key):
                    sizes[key] = _card_integer(card)
        if not 0 <= (n_axes := sizes.get("NAXIS", 0)) <= _MOST_AXES:
            raise ValueError(f"HDU {index} of the FITS file cannot have {n_axes} axes")
        axes = [sizes.get(f"NAXIS{k}", 0) for k in range(1, n_axes + 1)]
        if axes and axes[0] == 0:
            axes = axes[1:]  # random groups
        elements = int(np.prod(axes, dtype=object)) if axes else 0
        size = abs(sizes.get("BITPIX", 8)) // 8 * sizes.get("GCOUNT", 1) * (sizes.get("PCOUNT", 0) + elements)
        check(min([size, *axes]) >= 0, f"HDU {index} of the FITS file has a negative size")
        offset += -(-size // _BLOCK) * _BLOCK
        if offset > len(data):
            raise ValueError(
                f"the FITS file is truncated: HDU {index} reaches to byte {offset}, the file has {len(data)}"
            )
        index += 1


def _card_integer(card: str) -> int:
    try:
        return int(card[10:].split("/")[0])
    except ValueError:
        raise ValueError(f"the FITS card {card.strip()!r} needs a whole number") from None
