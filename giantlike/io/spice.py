"""SPICE: loading of kernels, look-up of states and orientations, all geometric, in km, ``et`` and J2000 axes.

SPICE keeps one pool of kernels per process, which is not thread-safe; a worker process loads its kernels again.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike._system.child import in_child
from giantlike._system.reading import file_sha256, library_message, reads
from giantlike.core.arrays import Float, require
from giantlike.core.errors import DataError
from giantlike.core.time import time_from_et, utc_text
from giantlike.io.daf import require_whole_daf, try_segments
from giantlike.shapes import Ellipsoid

_LOG = logging.getLogger("giantlike.io")

Answer = TypeVar("Answer")

_TRANSFER = (b"DAFETF", b"DASETF")
_FILE_RECORD = 1024  # bytes, of DAF files: NAIF's DAF Required Reading
_LONGEST_PATH = 1000  # characters of a kernel's path: SPICE takes 255; path symbols within symbols grow beyond any
_DEEPEST = 8  # meta-kernels that list meta-kernels: more are treated as a cycle
_DATA_SECTION = re.compile(
    r"^[ \t]*\\begindata[ \t]*\r?$(.*?)(?:^[ \t]*\\begintext[ \t]*\r?$|\Z)", re.MULTILINE | re.DOTALL
)
_ASSIGNMENT = re.compile(r"\b([A-Za-z]\w*+)\s*+\+?=\s*(\((?:'(?:[^']|'')*+'|[^()'])*+\)|'(?:[^']|'')*+'|\S+)")
_QUOTED = re.compile(r"'((?:[^']|'')*+)'")
_UNKNOWN_NAME = ("IDCODENOTFOUND", "NOTRANSLATION", "UNKNOWNFRAME", "bods2c")


class CoverageError(DataError):
    """A body, a frame or a time that the loaded kernels do not cover."""

    def __init__(self, problem: str) -> None:
        super().__init__("SPICE kernels", problem)

    def __reduce__(self) -> tuple[type[CoverageError], tuple[str]]:  # type: ignore[override]
        return type(self), (self.problem,)


@dataclass(frozen=True, slots=True)
class SpiceKernels:
    """Kernels that were loaded together; a context manager that unloads them.

    Parameters
    ----------
    paths : tuple of Path; in loading order: where two overlap, SPICE prefers the later one
    """

    paths: tuple[Path, ...]

    def sha256(self) -> dict[str, str]:
        """SHA-256 of each file, hexadecimal, by path, for provenance; reads them all."""
        return {str(path): file_sha256(path) for path in self.paths}

    def unload(self) -> None:
        """Remove the kernels from the process's pool."""
        import spiceypy

        for path in reversed(self.paths):
            spiceypy.unload(str(path))

    def __enter__(self) -> SpiceKernels:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.unload()


def find_kernels(patterns: Sequence[str | Path], base: str | Path) -> tuple[Path, ...]:
    """Kernel files of patterns, in loading order, without loading them."""
    found: list[Path] = []
    for pattern in map(str, patterns):
        full = Path(base).absolute() / pattern
        if any(character in pattern for character in "*?["):
            anchor = Path(full.anchor)
            matches = sorted(path for path in anchor.glob(str(full.relative_to(anchor))) if path.is_file())
        else:
            matches = [full] if full.is_file() else []
        if not matches:
            raise DataError(full, "SPICE kernel not found: no file of this name or pattern")
        found = [path for path in found if path not in matches] + matches
    return tuple(found)


def load_kernels(patterns: Sequence[str | Path], base: str | Path, *, trusted: bool = False) -> SpiceKernels:
    """Load SPICE kernels into this process.

    All files are searched and checked before the first is loaded. SPICE itself reads files that are cut off
    or no kernels at all without complaint; they are refused here. A damaged one can end the process: all are
    loaded in another process first. A meta-kernel is replaced by the kernels it
    lists, whose paths are relative to the meta-kernel's own folder (SPICE alone takes them from the
    working directory).

    Parameters
    ----------
    patterns : sequence of path-like; paths or glob patterns, as for :func:`find_kernels`
    base : path-like; folder that relative paths start from
    trusted : bool; they were loaded before, by another process of this run: do not try them first

    Raises
    ------
    DataError
        A kernel is missing, cut off, no kernel, or refused by SPICE; none of them is left loaded.
    """
    import spiceypy
    from spiceypy.utils.exceptions import SpiceyError

    paths: list[Path] = []
    for path in find_kernels(patterns, base):
        expanded = _list_kernels(path)
        paths = [known for known in paths if known not in expanded] + expanded
    if not trusted:
        _require_loadable(paths)
    loaded: list[Path] = []
    for path in paths:
        try:
            spiceypy.furnsh(str(path))
        except SpiceyError as error:
            SpiceKernels(tuple(loaded)).unload()
            raise DataError(path, f"SPICE cannot load this kernel: {library_message(error)}") from error
        loaded.append(path)
        _LOG.debug("loaded the kernel %s", path)
    return SpiceKernels(tuple(loaded))


def try_kernels(paths: Sequence[Path]) -> dict[str, Float]:
    """Load kernels as :func:`load_kernels` does, in a process that may end at a damaged one."""
    import spiceypy

    for path in paths:
        spiceypy.furnsh(str(path))
    for path in paths:
        try_segments(path)
    return {}


def _require_loadable(paths: Sequence[Path]) -> None:
    """Raise :class:`DataError` for the first kernel that SPICE does not load or breaks down at."""
    if len(paths) == 1:
        reads("a SPICE kernel")(_require_alone)(paths[0])
        return
    try:
        in_child(try_kernels, paths, libraries=["spiceypy"])
    except ValueError as error:
        for path in paths:
            reads("a SPICE kernel")(_require_alone)(path)
        raise DataError(paths[-1], f"SPICE cannot load this kernel after the others: {error}") from error


def _require_alone(path: Path) -> None:
    in_child(try_kernels, [path], libraries=["spiceypy"])


def spk_state(target: str | int, et: float, *, observer: str | int, frame: str = "J2000") -> tuple[Float, Float]:
    """Geometric state of ``target`` relative to ``observer``."""
    import spiceypy

    state, _ = _ask(
        lambda: spiceypy.spkezr(str(target), et, frame, "NONE", str(observer)),
        et,
        f"no state of {target} relative to {observer} in {frame}",
        "load SPK kernels that link the two at this time",
    )
    values = np.asarray(state, dtype=np.float64)
    return values[:3], values[3:]


def orientation(frame_or_body: str | int, et: float) -> Rotation:
    """Orientation ``inertial_from_body`` of a frame or of a body's own fixed frame."""
    import spiceypy

    def body_from_inertial() -> Float:
        name = str(frame_or_body)
        if spiceypy.namfrm(name) != 0:
            return np.asarray(spiceypy.pxform("J2000", name, et))
        body = spiceypy.bods2c(name)
        try:
            _, frame = spiceypy.cidfrm(body)
        except spiceypy.NotFoundError:
            return np.asarray(spiceypy.tipbod("J2000", body, et))
        return np.asarray(spiceypy.pxform("J2000", frame, et))

    matrix = _ask(
        body_from_inertial,
        et,
        f"no orientation of {frame_or_body}",
        "load the PCK, or the CK with its SCLK and frame kernels, that covers this time",
    )
    return Rotation.from_matrix(matrix).inv()


def attitude(frame: str, et: float) -> Rotation:
    """Attitude ``camera_from_inertial`` of an instrument frame, in axes of that frame."""
    import spiceypy

    matrix = _ask(
        lambda: spiceypy.pxform("J2000", frame, et),
        et,
        f"no attitude of frame {frame}",
        "load the frame kernel that defines it, and a CK with its SCLK kernel that covers this time",
    )
    return Rotation.from_matrix(np.asarray(matrix))


def body_radii_km(body: str | int) -> Float:
    """Radii of a body's reference ellipsoid along its own axes. Returns (3,)."""
    import spiceypy

    _, radii = _ask(
        lambda: spiceypy.bodvrd(str(body), "RADII", 3), None, f"no radii of {body}", "load a PCK that has them"
    )
    return np.asarray(radii, dtype=np.float64)


def ellipsoid_from_pck(body: str | int, kernels: Sequence[str | Path] = (), base: str | Path = ".") -> Ellipsoid:
    """Reference ellipsoid of a body by its name, from a planetary constants kernel (PCK)."""
    with load_kernels(kernels, base) if kernels else nullcontext():
        radii_km = body_radii_km(body)
    return Ellipsoid(radii_km=radii_km, name=str(body))


def rotation_coefficients(body: str) -> tuple[Float, Float, Float] | None:
    """Coefficients of the pole and the prime meridian of a body, deg, by the loaded kernels; None without."""
    import spiceypy

    code, found = body_id(body), list[Float]()
    for item in ("POLE_RA", "POLE_DEC", "PM"):
        name = f"BODY{code}_{item}"
        if code is None or not spiceypy.expool(name):
            return None
        found.append(np.asarray(spiceypy.gdpool(name, 0, 3), dtype=np.float64))
    return found[0], found[1], found[2]


def body_id(name: str) -> int | None:
    """NAIF code of a body by its name or code; None for a name that the loaded kernels do not define."""
    import spiceypy

    try:
        return int(spiceypy.bods2c(name))
    except spiceypy.NotFoundError:
        return None


def spk_coverage() -> dict[int, tuple[str, tuple[float, float]]]:
    """Name and first and last epoch (TDB seconds past J2000) of every body of the loaded SPK kernels, by its code."""
    import spiceypy

    covered: dict[int, tuple[str, tuple[float, float]]] = {}
    for number in range(spiceypy.ktotal("SPK")):
        path = spiceypy.kdata(number, "SPK")[0]
        for code in map(int, spiceypy.spkobj(path)):
            ends = [*covered[code][1]] if code in covered else []
            window = spiceypy.spkcov(path, code)
            for place in range(spiceypy.wncard(window)):
                ends += spiceypy.wnfetd(window, place)
            covered[code] = (body_name(code), (min(ends), max(ends)))
    return covered


def spk_center(code: int, et: float) -> int | None:
    """Body relative to which the loaded kernels have a state; None where they have none."""
    import spiceypy

    try:
        _, descriptor, _ = spiceypy.spksfs(code, et, 41)  # SIDLEN, 40 characters and the end
    except spiceypy.NotFoundError:
        return None
    return int(spiceypy.dafus(descriptor, 2, 6)[1][1])


def body_name(code: int) -> str:
    """Name of a body; its code where it has none."""
    import spiceypy

    try:
        return str(spiceypy.bodc2n(code))
    except spiceypy.NotFoundError:
        return str(code)


def frame_names() -> list[str]:
    """Names of the frames that SPICE and the loaded kernels define."""
    import spiceypy

    codes = [*spiceypy.bltfrm(-1), *spiceypy.kplfrm(-1)]
    return sorted({str(spiceypy.frmnam(int(code))) for code in codes})


def frame_center(name: str) -> int | None:
    """Code of the body to which a frame belongs; None for a name that is not the name of a frame."""
    import spiceypy

    code = spiceypy.namfrm(name)
    return None if code == 0 else int(spiceypy.frinfo(code)[0])


def has_leap_seconds() -> bool:
    """Return True if a leapseconds kernel is loaded."""
    import spiceypy

    return bool(spiceypy.expool("DELTET/DELTA_AT"))


def _ask(question: Callable[[], Answer], et: float | None, subject: str, advice: str) -> Answer:
    """Answer of SPICE to a question, its errors as a :class:`CoverageError` of one line."""
    import spiceypy
    from spiceypy.utils.exceptions import SpiceyError

    require(et is None or math.isfinite(et), f"{subject}: et must be finite, got {et}")
    try:
        return question()
    except (SpiceyError, spiceypy.NotFoundError) as error:
        message = library_message(error)
        if any(name in message for name in _UNKNOWN_NAME):
            advice = "a name is not known: use the NAIF id, or load the kernel that defines it"
        when = "" if et is None else f" at {utc_text(time_from_et(et))} UTC"
        raise CoverageError(f"{subject}{when}: {advice} ({message})") from error


def _list_kernels(path: Path, depth: int = 0) -> list[Path]:
    """The kernel itself, checked, or the kernels that a meta-kernel lists."""
    text = _kernel_text(path)
    listed = [] if text is None else _meta_kernel_paths(path, text)
    if not listed:
        return [path]
    if depth > _DEEPEST:
        raise DataError(path, "meta-kernels list each other in a loop")
    paths: list[Path] = []
    for name in listed:
        full = path.parent / name
        if not full.is_file():
            raise DataError(path, f"the meta-kernel lists {name!r}, which does not exist in {path.parent}")
        paths += _list_kernels(full, depth + 1)
    return paths


@reads("a SPICE kernel")
def _kernel_text(path: Path) -> str | None:
    """Content of a text kernel, None for a binary one; refuses files that are not complete kernels."""
    with path.open("rb") as file:
        head = file.read(_FILE_RECORD)
    if head.startswith(_TRANSFER):
        raise DataError(path, "is a SPICE transfer file: convert it to a binary kernel with NAIF's tobin")
    if head.startswith((b"DAF/", b"NAIF/DAF")):
        require_whole_daf(path)
        return None
    if head.startswith((b"DAS/", b"NAIF/DAS")):
        return None
    text = path.read_bytes().decode("latin-1")
    if _DATA_SECTION.search(text) is None:
        raise DataError(path, "is not a SPICE kernel: neither a DAF or DAS file nor text with a \\begindata section")
    return text


def _meta_kernel_paths(path: Path, text: str) -> list[str]:
    """Files that a meta-kernel lists, its path symbols replaced; none for any other text kernel."""
    data = "\n".join(section[1] for section in _DATA_SECTION.finditer(text))
    variables: dict[str, list[str]] = {}
    for name, value in _ASSIGNMENT.findall(data):
        strings = [quoted.replace("''", "'") for quoted in _QUOTED.findall(value)]
        variables.setdefault(name.upper(), []).extend(strings)
    names = _join_continued(variables.get("KERNELS_TO_LOAD", []))
    if not names:
        return []
    symbols, values = variables.get("PATH_SYMBOLS", []), _join_continued(variables.get("PATH_VALUES", []))
    if len(symbols) != len(values):
        raise DataError(path, f"the meta-kernel has {len(symbols)} PATH_SYMBOLS, but {len(values)} PATH_VALUES")
    others = sorted(set(variables) - {"KERNELS_TO_LOAD", "PATH_SYMBOLS", "PATH_VALUES"})
    if others:
        raise DataError(path, f"the meta-kernel also sets {others[0]}: move that to a kernel of its own")
    for symbol, value in zip(symbols, values, strict=True):
        names = [name.replace(f"${symbol}", value) for name in names]
        if any(len(name) > _LONGEST_PATH for name in names):
            raise DataError(path, f"the meta-kernel lists a path of more than {_LONGEST_PATH} characters")
    return names


def _join_continued(strings: list[str]) -> list[str]:
    """Strings of which one that ends in ``+`` is continued by the next."""
    joined: list[str] = []
    continues = False
    for string in strings:
        part = string.rstrip()
        whole = joined.pop() + part if continues else part
        continues = part.endswith("+")
        joined.append(whole.removesuffix("+") if continues else whole)
    return joined
