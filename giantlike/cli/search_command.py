"""``giantlike search``: what is near the body and among the stars of a run that neither explains, and where it goes."""

from __future__ import annotations

import base64
from dataclasses import dataclass, replace
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer

from giantlike._system.atomic import make_folder, write_text_atomic
from giantlike.campaign.run.image_loading import scene_of
from giantlike.cli.arguments import Json, Run
from giantlike.cli.outcome import ExitCode, say, show_result
from giantlike.core.arrays import require
from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import radec_from_direction
from giantlike.core.outcomes import Failure
from giantlike.core.time import time_from_et, utc_text
from giantlike.dynamics import PointMasses
from giantlike.image import Image
from giantlike.io.csv_rows import write_csv_rows
from giantlike.io.tables import column, write_rows
from giantlike.scene import Scene
from giantlike.search import (
    LinkOptions,
    MotionFix,
    MotionOptions,
    Orbit,
    ResidualOptions,
    Residuals,
    Track,
    compare_residuals,
    fit_motion,
    link,
    residual_sources,
)  # fmt: skip
from giantlike.viewer.session import Session

_CUT_HALF_PX, _CUT_SCALE = 12, 4  # half side of cut-outs, px, and how much larger the page shows them
_MOST_SHOWN = 100  # tracks on the page, those of the least chance
_TRACKS = (
    "track", "accepted", "expected_false", "detections", "missed", "first_utc", "last_utc", "ra_deg", "dec_deg",
    "rate_px_s", "trail_angle_deg", "snr", "magnitude", "optics", "chi2", "freedom", "model", "et", "x_km", "y_km",
    "z_km", "vx_km_s", "vy_km_s", "vz_km_s", "covariance", "detail",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceRow:
    """A row of ``sources.parquet``: a source of an image."""

    file: str = column("Image.")
    et: float = column("Mid-exposure, TDB seconds past J2000.", "s")
    x_px: float = column("Centroid, along a row.", "px", "image")
    y_px: float = column("Centroid, along a column.", "px", "image")
    sigma_px: float = column("Standard deviation per axis, attitude left out.", "px", "image")
    ra_deg: float = column("Apparent right ascension.", "deg", "ICRF")
    dec_deg: float = column("Apparent declination.", "deg", "ICRF")
    flux_dn: float = column("Light.", "DN")
    snr: float = column("Signal-to-noise ratio.")
    magnitude: float | None = column("Magnitude, where the camera has a zero point.", "mag")
    source_class: str = column("Class of the source.")
    optics: float = column("Probability that the light came through the optics.")
    half_x_px: float = column("From the middle of a streak to one end; 0 for a point.", "px", "image")
    half_y_px: float = column("From the middle of a streak to one end; 0 for a point.", "px", "image")
    track: int | None = column("Number of the track that goes through it.")


def search(
    run: Run,
    body: Annotated[str | None, typer.Option(help="Body of the orbits; by default the first.", metavar="NAME")] = None,
    max_rate: Annotated[float, typer.Option(help="Largest motion on the sky.", metavar="PX_S")] = 0.2,
    threshold: Annotated[float, typer.Option(help="Detection limit, in sigma.")] = 5.0,
    min_detections: Annotated[int, typer.Option(help="Fewest sources of a track.")] = 4,
    gm: Annotated[float | None, typer.Option(help="Gravity of the body: fits orbits.", metavar="KM3_S2")] = None,
    output: Annotated[Path | None, typer.Option(help="Output folder; by default RUN/search.", metavar="DIR")] = None,
    json: Json = False,
) -> ExitCode:
    """Find what moves in the images of a run: sources that nothing explains, tracks, orbits.

    Attitudes are those of the run. Writes sources.parquet (and .csv), tracks.csv and search.html.
    """
    require(gm is None or gm > 0.0, f"--gm must be above 0, got {gm}")
    linking = LinkOptions(max_rate_px_s=max_rate, min_detections=min_detections)
    session, options = Session(run), ResidualOptions(threshold_sigma=threshold)
    names = [target.name for target in session.workbench.campaign.targets]
    require(body is None or body in names, f"--body: the campaign has no body {body!r}, only {', '.join(names)}")
    found, failed = _find_sources(session, options, body)
    why = "; ".join(dict.fromkeys(failed.values())) or "it has no images"
    require(bool(found), f"{run}: no image can be searched: {why}")
    for first, second in pairwise(list(found)):
        if found[first].et >= found[second].et:
            failed[second] = f"its epoch is that of {first}: it is left out"
            found[second] = found[first]
    sequence = compare_residuals(list({one.name: one for one in found.values()}.values()))
    if gm is not None and sequence[0].body_position_km is not None:
        linking = replace(linking, max_acceleration_px_s2=_acceleration(session, sequence, body or names[0], gm))
    tracks = link(sequence, linking)
    motion = MotionOptions(gravity=None if gm is None else PointMasses(gm))
    fits = [fit_motion(track, motion) for track in tracks]
    folder = run / "search" if output is None else output
    make_folder(folder)
    write_rows(folder / "sources", SourceRow, _source_rows(sequence, tracks))
    rows = [_track_row(k, track, fit) for k, (track, fit) in enumerate(zip(tracks, fits, strict=True), 1)]
    write_csv_rows(folder / "tracks.csv", _TRACKS, [list(row.values()) for row in rows])
    counts: dict[str, int] = {}
    for one in sequence:
        for name, count in one.counts().items():
            counts[name] = counts.get(name, 0) + count
    accepted = sum(track.accepted for track in tracks)
    summary: dict[str, Any] = {
        "images": len(sequence),
        "sources": counts,
        "tracks": rows,
        "accepted": accepted,
        "expected_false": sum(track.expected_false for track in tracks if track.accepted),
        "failed": failed,
    }
    lines = [
        f"{len(sequence)} images: " + ", ".join(f"{count} {name}" for name, count in sorted(counts.items())),
        *(
            f"track {row['track']}: {row['detections']} detections, {row['rate_px_s']:.4g} px/s, "
            f"SNR {row['snr']:.1f}, {row['expected_false']:.2g} false ones expected"
            + ("" if row["accepted"] else "  (not accepted)")
            for row in rows[:20]
        ),
        f"{accepted} tracks accepted, of which {summary['expected_false']:.2g} are expected to be false",
    ]
    if len(sequence) < min_detections:
        lines.append(f"tracks need {min_detections} images: there are {len(sequence)}; single sources and streaks only")
    write_text_atomic(folder / "search.html", _page(session, run, lines, tracks, rows))
    for file, reason in failed.items():
        say(f"giantlike: {file}: {reason}")
    return show_result(
        summary | {"folder": str(folder)}, [*lines, f"wrote {folder / 'search.html'}, tracks.csv, sources.parquet"],
        json=json, failed=bool(failed),
    )  # fmt: skip


def _find_sources(
    session: Session, options: ResidualOptions, body: str | None
) -> tuple[dict[str, Residuals], dict[str, str]]:
    """Sources of the images of a run by image, in order of time, and why others have none."""
    navigation = session.workbench.navigation
    found: dict[str, Residuals] = {}
    failed: dict[str, str] = {}
    for record in session.result.attitudes:
        if not record.outcome.is_usable or record.attitude is None:
            failed[record.file] = "no_attitude: the run has none that is usable"
            continue
        try:
            image = session.image(record.file)
            scene = _scene(session, image, body)
            catalog = None if navigation is None else navigation.catalog
            answer = residual_sources(image, session.camera, None, catalog, scene, options)
        except (InputError, DataError) as error:
            failed[record.file] = str(error)
            continue
        if isinstance(answer, Failure):
            failed[record.file] = f"{answer.reason}: {answer.detail}"
        else:
            found[record.file] = replace(answer, name=record.file)
            if len(answer) == options.max_sources:
                say(f"giantlike: {record.file}: the {options.max_sources} most significant sources are kept")
    return dict(sorted(found.items(), key=lambda item: item[1].et)), failed


def _scene(session: Session, image: Image, body: str | None) -> Scene | None:
    """Scene of all bodies of an image whose geometry is known, that of the orbits first."""
    bench = session.workbench
    ordered = sorted(bench.campaign.targets, key=lambda target: target.name != body)
    scenes = [scene_of(bench.campaign, image, target, bench.shapes[target.name]) for target in ordered]
    known = [one for one in scenes if isinstance(one, Scene)]
    return replace(known[0], targets=tuple(one.targets[0] for one in known)) if known else None


def _acceleration(session: Session, sequence: list[Residuals], body: str, gm: float) -> float:
    """Acceleration at the surface of the body, px/s^2, seen from the nearest image."""
    radius_km = session.workbench.shapes[body].mean_radius_km
    ranges = [float(np.linalg.norm(one.body_position_km)) for one in sequence if one.body_position_km is not None]
    return gm / radius_km**2 / min(ranges) / float(session.camera.ifov_rad())


def _source_rows(sequence: list[Residuals], tracks: tuple[Track, ...]) -> list[SourceRow]:
    owner = {
        (one.name, int(i)): number
        for number, track in enumerate(tracks, 1)
        for one, i in zip(track.residuals, track.sources, strict=True)
    }
    rows = []
    for one in sequence:
        ra, dec = radec_from_direction(one.directions_inertial)
        sigma = np.sqrt(np.trace(one.covariance_px2, axis1=1, axis2=2) / 2.0)
        for i in range(len(one)):
            magnitude = float(one.magnitude[i])
            rows.append(
                SourceRow(
                    file=one.name, et=one.et, x_px=float(one.points_px[i, 0]), y_px=float(one.points_px[i, 1]),
                    sigma_px=float(sigma[i]), ra_deg=float(ra[i]), dec_deg=float(dec[i]),
                    flux_dn=float(one.flux_dn[i]), snr=float(one.snr[i]),
                    magnitude=magnitude if np.isfinite(magnitude) else None, source_class=str(one.kinds[i]),
                    optics=float(one.optics[i]), half_x_px=float(one.halves_px[i, 0]),
                    half_y_px=float(one.halves_px[i, 1]), track=owner.get((one.name, i)),
                )
            )  # fmt: skip
    return rows


def _track_row(number: int, track: Track, fit: MotionFix | Failure) -> dict[str, Any]:
    ra, dec = radec_from_direction(track.direction_inertial)
    magnitudes = track.values("magnitude")
    orbit = fit.orbit if isinstance(fit, MotionFix) else fit
    state = [*orbit.state.tolist()] if isinstance(orbit, Orbit) else [None] * 6
    upper = orbit.covariance[np.triu_indices(6)].tolist() if isinstance(orbit, Orbit) else []
    first, last = (utc_text(time_from_et(float(et))) for et in track.ets[[0, -1]])
    values = (
        number, track.accepted, track.expected_false, len(track), len(track.missed), first, last,
        float(ra), float(dec), float(np.hypot(*track.rate_px_s)),
        float(np.degrees(np.arctan2(*track.rate_px_s[::-1]))), float(np.median(track.values("snr"))),
        float(np.nanmedian(magnitudes)) if np.isfinite(magnitudes).any() else None,
        float(np.median(track.values("optics"))), track.chi2, track.freedom,
        fit.model if isinstance(fit, MotionFix) else "", orbit.et if isinstance(orbit, Orbit) else track.et, *state,
        " ".join(f"{value:.17g}" for value in upper), orbit.detail if isinstance(orbit, Failure) else "",
    )  # fmt: skip
    return dict(zip(_TRACKS, values, strict=True))


def _page(session: Session, run: Path, lines: list[str], tracks: tuple[Track, ...], rows: list[dict[str, Any]]) -> str:
    """Page with the tracks and a cut-out of every source of them."""
    pixels = {name: session.pixels(name).pixels for name in {one.name for track in tracks for one in track.residuals}}
    parts = [f"<p>{escape(line)}</p>" for line in lines if not line.startswith("track ")]
    for track, row in list(zip(tracks, rows, strict=True))[:_MOST_SHOWN]:
        told = ", ".join(
            f"{name} {row[name]:.4g}" for name in ("expected_false", "rate_px_s", "snr", "ra_deg", "dec_deg")
        )
        parts.append(f"<h2>Track {row['track']}{'' if track.accepted else ' (not accepted)'}</h2><p>{told}</p>")
        parts += [f"<p>{escape(row['detail'])}</p>"] if row["detail"] else []
        for one, point in zip(track.residuals, track.values("points_px"), strict=True):
            parts.append(
                f"<figure>{_cut_out(pixels[one.name], point)}<figcaption>{escape(one.name)}</figcaption></figure>"
            )
    title = escape(f"{run.name}: what moves")
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>'
        "body{font-family:sans-serif;margin:2rem}figure{display:inline-block;margin:.3rem;font-size:.7rem}"
        f"img{{image-rendering:pixelated}}</style></head><body><h1>{title}</h1>{''.join(parts)}</body></html>\n"
    )


def _cut_out(pixels: Any, point_px: Any) -> str:
    """Image tag with the pixels about a point, black at their median and white at their brightest."""
    x, y = np.rint(point_px).astype(int)
    cut = np.pad(np.asarray(pixels, dtype=np.float64), _CUT_HALF_PX, mode="edge")
    cut = cut[y : y + 2 * _CUT_HALF_PX + 1, x : x + 2 * _CUT_HALF_PX + 1]
    low, high = float(np.median(cut)), float(cut.max())
    gray = np.clip(255.0 * (cut - low) / max(high - low, 1e-12), 0.0, 255.0).astype(np.uint8)
    data = base64.b64encode(cv2.imencode(".png", gray)[1].tobytes()).decode("ascii")
    side = _CUT_SCALE * (2 * _CUT_HALF_PX + 1)
    return f'<img alt="cut-out" width="{side}" height="{side}" src="data:image/png;base64,{data}">'
