"""Small valid files of every kind that the package reads, each with its reader: what hostile files are made from."""

from __future__ import annotations

import gzip
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import spiceypy
import tomli_w
import trimesh

import giantlike as gl
from giantlike._system.reading import file_sha256
from giantlike.campaign.compare import external
from giantlike.campaign.file.config import Campaign
from giantlike.campaign.render.plan import RenderPlan
from giantlike.campaign.store.edits import Edit, Edited, add_edits
from giantlike.campaign.store.records import ObservationRecord, TargetRecord, TargetView
from giantlike.campaign.store.results import camera_of_run, load_result
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.catalogs import load_catalog
from giantlike.catalogs.readers import build_catalog
from giantlike.catalogs.stored import save_catalog
from giantlike.cli.frames_input import frames_table
from giantlike.core.causes import Cause
from giantlike.gauntlet.files import load_results, save_results
from giantlike.gauntlet.run import Gauntlet, ImageResult
from giantlike.gauntlet.trial import TrialRow
from giantlike.io import load_kernels, read_ephemeris_table, read_geometry
from giantlike.io.attitude_series import read_attitude_csv, read_attitude_table
from giantlike.io.camera_import import read_foreign_camera
from giantlike.io.camera_opencv import write_opencv_camera
from giantlike.io.epic_metadata import read_epic
from giantlike.io.image_files import read_image_file
from giantlike.io.isis_network import read_control_network, read_image_support
from giantlike.io.observables_file import read_observables, write_observables
from giantlike.io.orbit_covariance import COLUMNS, read_orbit_covariance
from giantlike.io.spc_geometry import read_sumfiles
from giantlike.io.spc_lmk import read_lmk, write_lmk
from giantlike.io.spc_sumfile import read_sumfile, write_sumfile
from giantlike.observables import row_of_body, row_of_landmark
from giantlike.observables.exchange import sumfile_of
from giantlike.shapes import Ellipsoid, load_shape, mesh_from_ellipsoid, save_shape
from giantlike.shapes.files.dsk import DskIdentity
from giantlike.shapes.landmarks import LandmarkCatalog, landmark_of, load_landmarks, save_landmarks
from giantlike.stars import star_index
from giantlike.stars.rates import read_rates
from giantlike.terrain import HeightMap
from giantlike.viewer.dossier import check_dossier
from tests.camera_models.test_camera_models import NAVCAM
from tests.campaign import test_export as run_files
from tests.campaign_files import campaign_table
from tests.catalogs import test_catalog_readers as catalog_files
from tests.cli.test_render_command import scene_table
from tests.io import test_camera_files as camera_files
from tests.io import test_image_files as image_files
from tests.io import test_planetary_files as planetary_files
from tests.io import test_spc_lmk
from tests.io import test_spice as kernel_files
from tests.io.height_map_files import heights_km, write_geotiff, write_pds3
from tests.io.test_epic_metadata import RECORDS
from tests.io.test_isis_network import CONTROL_NETWORK, IMAGE_SUPPORT
from tests.observables import test_rows as exchange
from tests.shapes.test_local_maps import _map

EPOCHS = ("2020-01-01T00:00:00", "2020-01-01T00:01:00", "2020-01-01T00:02:00")
MESH = mesh_from_ellipsoid(Ellipsoid(radii_km=np.array([3.0, 2.0, 1.0])), facets=80)


@dataclass(frozen=True)
class Kind:
    """A kind of file: the name of one, how to write a valid one, and what reads it."""

    file: str
    write: Callable[[Path], object]
    read: Callable[[Path], object]


def _read_epic(path: Path) -> object:
    return read_epic(path, [Path(f"{record['identifier']}.png") for record in RECORDS], {"EARTH": "EARTH"})


def _with(text: str | bytes) -> Callable[[Path], object]:
    content = text.encode() if isinstance(text, str) else text
    return lambda path: path.write_bytes(content)


def _encoded(suffix: str, pixels: np.ndarray) -> bytes:
    return bytes(cv2.imencode(suffix, pixels)[1].tobytes())


def _exported(kind: str) -> bytes:
    mesh = trimesh.Trimesh(MESH.vertices_km, MESH.faces, process=False)
    if kind == "stl":
        return bytes(trimesh.exchange.stl.export_stl_ascii(mesh).encode())
    data = mesh.export(file_type="ply", encoding="ascii")
    return data.encode() if isinstance(data, str) else bytes(data)


def _table(columns: str, values: str) -> str:
    return "\n".join([f"epoch_utc,{columns}", *(f"{epoch},{values}" for epoch in EPOCHS)]) + "\n"


def _spk(path: Path) -> None:
    handle = spiceypy.spkopn(str(path), "made up", 0)
    states = [[1e6 + k, 2e6, 3e6, 1.0, 0.0, 0.0] for k in range(9)]
    spiceypy.spkw09(handle, 2000999, 10, "J2000", 0.0, 800.0, "made up", 3, 9, states, [100.0 * k for k in range(9)])
    spiceypy.spkcls(handle)


def _read_kernel(path: Path) -> None:
    with load_kernels([path], path.parent):
        pass


def _read_spk(path: Path) -> None:
    from giantlike.io.spice import spk_state

    with load_kernels([path], path.parent):
        spk_state(2000999, 350.0, observer=10)


def _read_catalog(form: str) -> Callable[[Path], object]:
    return lambda path: build_catalog([path], form, name="hostile")


def _raster(path: Path, pixels: np.ndarray) -> None:
    path.write_bytes(_encoded(path.suffix, pixels))


def _own_catalog(path: Path) -> None:
    source = path.with_name("stars.csv")
    source.write_text("ra_deg,dec_deg,magnitude\n" + "\n".join(f"{10 * k},{k},{k % 7}" for k in range(30)) + "\n")
    save_catalog(load_catalog(source), path, sources=[])


def _maplet(path: Path) -> None:
    half, spacing = 3, 0.01
    head = bytearray(72)
    struct.pack_into(">f", head, 6, spacing)
    struct.pack_into("<H", head, 10, half)
    axes = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    struct.pack_into(">13f", head, 15, 0.0, 0.0, 2.0, *axes, 0.01)
    path.write_bytes(bytes(head) + struct.pack(">hB", 5, 100) * (2 * half + 1) ** 2)


def _landmarks(path: Path) -> None:
    save_landmarks(LandmarkCatalog((landmark_of(_map()),)), path)


def _campaign(path: Path) -> None:
    (path.parent / "images").mkdir(exist_ok=True)
    (path.parent / "images" / "a.fits").write_bytes(b"")
    (path.parent / "geometry.csv").write_text("file\na.fits\n")
    gl.Camera(name="c", columns=8, rows=8, model=NAVCAM, psf=gl.GaussianPsf()).save(path.parent / "camera.toml")
    path.write_text(tomli_w.dumps(campaign_table()))


def _run(path: Path) -> None:
    """A run folder with one attitude and one observation, around the file."""
    folder = path.parent
    run_files._run(folder, [run_files._record(0)])
    seen = ObservationRecord(
        index=0, file="image_0.fits", target="ROCK", estimator="limb_matching", status="ok",
        predicted_px=[10.0, 20.0], predicted_camera_km=[1.0, 2.0, 300.0], center_px=[10.5, 20.5],
        covariance_px2=[[0.1, 0.0], [0.0, 0.1]], range_km=301.0, sigma_range_km=0.5, limb_px=[[9.0, 9.0], [8.0, 9.0]],
        parts={Cause.NOISE: [[0.1, 0.0], [0.0, 0.1]]}, flags=["saturated"], provenance={"a": "b"},
    )  # fmt: skip
    view = TargetView(
        target="ROCK", predicted_px=[10.0, 20.0], radius_px=3.0, outline_px=[[9.0, 9.0]], outline_lit=[True]
    )
    RunFolder(folder).save(seen, "key")
    RunFolder(folder).save(TargetRecord(index=0, file="image_0.fits", target="ROCK", view=view), "key")
    edit = Edit(action="reject", what=Edited.IMAGE, file="image_0.fits", who="ann", when_utc="2026", why="smear")
    add_edits(folder, [edit])


def _read_run(path: Path) -> None:
    load_result(path.parent)
    camera_of_run(path.parent)


def _gauntlet(path: Path) -> None:
    row = TrialRow(
        image=0, kind="nominal", estimator="stars", verdict="right", status="ok", solvable=1, sigmas=1.5, error_px=0.1,
        sigma_px=0.1, cpu_s=0.5, reason="a|b",
    )  # fmt: skip
    results = [ImageResult(index=k, kind="nominal", rows=(row, row), cpu_s=1.0, thumbnail=b"\xff\xd8x") for k in (0, 1)]
    save_results(path.parent, _GAUNTLET, results, append=True)


_GAUNTLET = Gauntlet(images=2, seed=1)


def _dossier(path: Path) -> None:
    (path.parent / "in.fits").write_bytes(b"x")
    files = {"in.fits": file_sha256(path.parent / "in.fits"), "gone": "0" * 64}
    content = {
        "inputs": [{"role": "image", "path": name, "sha256": digest} for name, digest in files.items()],
        "files": files, "campaign_file": "campaign.toml", "edits": [], "doubts": [],
        "versions": {"giantlike": "0.1", "python": "3", "platform": "x", "packages": {"numpy": "2.0"}},
    }  # fmt: skip
    path.write_text(json.dumps(content, indent=1))


def _observables(path: Path) -> None:
    body = row_of_body(exchange.CONTEXT, exchange.SIGHTING, exchange.position_fix(), is_preferred=True)
    write_observables(path, [body, body], {"camera": "c"})


def _index(path: Path) -> None:
    rng = np.random.default_rng(5)
    stars = rng.normal(size=(40, 3))
    stars /= np.linalg.norm(stars, axis=1, keepdims=True)
    made = star_index.build_index(star_index.Pattern.TRIAD, np.arange(40) + 1, stars, 0.4)
    np.savez(path, ids=made.ids, directions=made.directions, patterns=made.patterns, cells=made.cells)


def _read_index(path: Path) -> None:
    index = star_index._read(path, star_index.Pattern.TRIAD, 0.4)
    if index is not None:
        _, found = index.find(np.full((3, 3), 0.5), 0.3)
        assert np.isfinite(index.directions[index.patterns[found].astype(np.intp)]).all()


def _lmk(path: Path) -> None:
    write_lmk(path, test_spc_lmk.LANDMARK)


def _sumfile(path: Path) -> None:
    body = row_of_body(exchange.CONTEXT, exchange.SIGHTING, exchange.position_fix(), is_preferred=True)
    mark = row_of_landmark(exchange.CONTEXT, exchange.SIGHTING, exchange.position_fix(), exchange.LANDMARK)
    write_sumfile(path, sumfile_of(exchange.CAMERA, body, [mark]))


def _read_sumfile_geometry(path: Path) -> object:
    return read_sumfiles(path.parent, [path.with_name("a.fits")], ["ROCK"])


TDM = """CCSDS_TDM_VERS = 2.0
CREATION_DATE = 2024-01-01T00:00:00
ORIGINATOR = X
META_START
TIME_SYSTEM = UTC
PARTICIPANT_1 = SC
PARTICIPANT_2 = ROCK
ANGLE_TYPE = RADEC
REFERENCE_FRAME = ICRF
META_STOP
DATA_START
ANGLE_1 = 2024-01-01T00:00:00 120.5
ANGLE_2 = 2024-01-01T00:00:00 -20.25
DATA_STOP
"""
SEEN = (
    "file,target,x_px,y_px,sigma_x_px,sigma_y_px,range_km\na.fits,ROCK,1,2,0.1,0.1,300\nb.fits,ROCK,3,4,0.1,0.1,301\n"
)


def _frames(path: Path) -> None:
    gl.io.write_fits(path.with_name("b.fits"), PIXELS)
    path.write_text('[calibration_frames]\nbias = ["b.fits"]\n')


def _meta_kernel(path: Path) -> None:
    kernel_files.write_pck(path.with_name("k.tpc"))
    path.write_text(
        "KPL/MK\n\\begindata\nPATH_VALUES = ( '.' )\nPATH_SYMBOLS = ( 'K' )\nKERNELS_TO_LOAD = ( '$K/k.tpc' )\n"
        "\\begintext\n"
    )


PIXELS = (np.arange(24 * 20).reshape(20, 24) * 37 % 251).astype(np.uint8)
GYRO = _table("rate_x_rad_s,rate_y_rad_s,rate_z_rad_s", "1e-3,0,0")
ORBIT = _table("x_km,y_km,z_km,vx_km_s,vy_km_s,vz_km_s,body_qx,body_qy,body_qz,body_qw", "1,2,3,0,0,1,0,0,0,1")
GEOMETRY = (
    "file,epoch_utc,exposure_s,qx,qy,qz,qw,target,target_x_km,target_y_km,target_z_km\n"
    "a.fits,2020-01-01T00:00:00,0.5,0,0,0,1,ROCK,1,2,300\nb.fits,2020-01-01T00:00:09,0.5,0,0,0.6,0.8,ROCK,1,2,300\n"
)
GIANT_CAMERA = (
    '<CameraModels>\n<OREX><navcam module="giant.camera_models.x" type="BrownModel"><n_rows>1944</n_rows>'
    "<n_cols>2592</n_cols><kx>3473.3</kx><ky>np.float64(3473.4)</ky><kxy>0.0</kxy><px>1268.7</px><py>949.6</py>"
    "<k1>-0.539</k1><k2>0.388</k2><k3>-0.214</k3><p1>-2.55e-4</p1><p2>8.64e-4</p2>"
    "<temperature_coefficients>array([2.37e-05, 0.0, 0.0])</temperature_coefficients>"
    "<misalignment>array([0., 0., 0.])</misalignment></navcam></OREX></CameraModels>\n"
)
LEAPSECONDS = (
    "KPL/LSK\n\\begindata\nDELTET/DELTA_T_A = 32.184\nDELTET/K = 1.657D-3\nDELTET/EB = 1.671D-2\n"
    "DELTET/M = ( 6.239996D0 1.99096871D-7 )\nDELTET/DELTA_AT = ( 10, @1972-JAN-1\n 37, @2017-JAN-1 )\n\\begintext\n"
)
FRAME = (
    "KPL/FK\n\\begindata\nFRAME_NAV = -999001\nFRAME_-999001_NAME = 'NAV'\nFRAME_-999001_CLASS = 4\n"
    "FRAME_-999001_CLASS_ID = -999001\nFRAME_-999001_CENTER = -999\nTKFRAME_-999001_SPEC = 'ANGLES'\n"
    "TKFRAME_-999001_RELATIVE = 'J2000'\nTKFRAME_-999001_ANGLES = ( 1, 2, 3 )\nTKFRAME_-999001_AXES = ( 1, 2, 3 )\n"
    "TKFRAME_-999001_UNITS = 'DEGREES'\nNAIF_BODY_NAME += ( 'ROCK' )\nNAIF_BODY_CODE += ( 2000999 )\n\\begintext\n"
)


def _product(path: Path) -> None:
    """A PDS4 label; its data file stays as it is beside the damaged one."""
    planetary_files.save_product(path.parent, planetary_files.ramp())


def _image(path: Path) -> object:
    return read_image_file(path)


def _heights(path: Path) -> object:
    return HeightMap.open(path).heights_km(np.eye(3))


def _plain_heights(path: Path) -> Path:
    np.savez(path, heights_km=heights_km(), reference_radii_km=1737.4)
    return path


def _foreign(path: Path) -> object:
    return read_foreign_camera(path, instrument_id=-64361)


KINDS: dict[str, Kind] = {
    "image fits": Kind("a.fits", lambda path: gl.io.write_fits(path, PIXELS), _image),
    "image compressed fits": Kind("a.fits", lambda path: image_files.compressed_fits(path), _image),
    "image fits.gz": Kind(
        "a.fits.gz",
        lambda path: path.write_bytes(gzip.compress(image_files.plain_fits(path.with_name("p.fits")))),
        _image,
    ),
    "image png": Kind("a.png", lambda path: _raster(path, PIXELS), _image),
    "image tiff": Kind("a.tiff", lambda path: _raster(path, PIXELS.astype(np.uint16) * 200), _image),
    "image jpeg": Kind("a.jpg", lambda path: _raster(path, PIXELS), _image),
    "image vicar": Kind("a.vic", _with(image_files.vicar(PIXELS, items="TASK='X' A=3 B='it''s'")), _image),
    "image pds3": Kind(
        "a.img",
        lambda path: path.write_bytes(image_files.pds3_label("^IMAGE = 8").ljust(630) + image_files.pds3_rows(">i2")),
        _image,
    ),
    "image isis": Kind("a.cub", _with(planetary_files.cube_bytes(planetary_files.ramp())), _image),
    "image pds4": Kind("image.xml", lambda path: _product(path), _image),
    "camera": Kind(
        "camera.toml",
        lambda path: gl.Camera(name="c", columns=8, rows=8, model=NAVCAM, psf=gl.GaussianPsf()).save(path),
        gl.Camera.load,
    ),
    "camera opencv yaml": Kind("c.yml", lambda path: write_opencv_camera(path, NAVCAM, columns=8, rows=8), _foreign),
    "camera opencv xml": Kind("c.xml", lambda path: write_opencv_camera(path, NAVCAM, columns=8, rows=8), _foreign),
    "camera giant": Kind("g.xml", _with(GIANT_CAMERA), _foreign),
    "camera kernel": Kind("c.ti", _with(camera_files.IK.format(center="( 511.5, 511.5 )")), _foreign),
    **{
        f"shape {suffix}": Kind(
            f"s.{suffix}",
            lambda path: save_shape(MESH, path, dsk=DskIdentity(center=401, frame="IAU_PHOBOS")),
            load_shape,
        )
        for suffix in ("obj", "ply", "stl", "tab", "npz", "bds")
    },
    "shape text ply": Kind("s.ply", _with(_exported("ply")), load_shape),
    "shape text stl": Kind("s.stl", _with(_exported("stl")), load_shape),
    "heights pds3": Kind("h.img", lambda path: write_pds3(path, attached=True), _heights),
    "heights geotiff": Kind("h.tif", write_geotiff, _heights),
    "heights tiled geotiff": Kind("h.tif", lambda path: write_geotiff(path, tile=16, compression="zlib"), _heights),
    "heights npz": Kind("h.npz", _plain_heights, _heights),
    "heights tiled npz": Kind("h.npz", lambda path: HeightMap.open(_plain_heights(path)).save(path), _heights),
    "maplet": Kind("m.MAP", _maplet, load_landmarks),
    "landmarks": Kind("l.npz", _landmarks, load_landmarks),
    "catalog": Kind("c.stars", _own_catalog, lambda path: load_catalog(path).cone(np.array([1.0, 0, 0]), 0.5)),
    "catalog csv": Kind("c.csv", _with("ra_deg,dec_deg,magnitude\n10,20,3\n11,21,4.5\n"), load_catalog),
    "catalog hipparcos": Kind("hip_main.dat", _with(catalog_files._hip_main() + b"\n"), _read_catalog("hipparcos")),
    "catalog tycho2": Kind(
        "tyc2.dat",
        _with(catalog_files.TYCHO_FIRST + "\n" + catalog_files.TYCHO_NO_MEAN + "\n"),
        _read_catalog("tycho2"),
    ),
    "catalog ucac4": Kind("z001", _with(catalog_files._ucac4() * 3), _read_catalog("ucac4")),
    "catalog usno": Kind("gnc.csv", _with(catalog_files.GNC), _read_catalog("usno-gnc")),
    "catalog gaia csv": Kind("g.csv", catalog_files._write_csv, _read_catalog("gaia")),
    "catalog gaia fits": Kind("g.fits", catalog_files._write_fits, _read_catalog("gaia")),
    "catalog gaia ecsv": Kind("g.ecsv", catalog_files._write_ecsv, _read_catalog("gaia")),
    "catalog gaia parquet": Kind("g.parquet", catalog_files._write_parquet, _read_catalog("gaia")),
    "catalog gaia votable": Kind("g.vot", catalog_files._write_votable, _read_catalog("gaia")),
    "rates": Kind("gyro.csv", _with(GYRO), read_rates),
    "ephemeris": Kind("orbit.csv", _with(ORBIT), read_ephemeris_table),
    "geometry": Kind("geometry.csv", _with(GEOMETRY), read_geometry),
    "epic metadata": Kind("epic.json", _with(json.dumps(RECORDS)), _read_epic),
    "attitudes": Kind("attitudes.csv", _with(_table("qx,qy,qz,qw", "0,0,0,1")), read_attitude_csv),
    "campaign": Kind("campaign.toml", _campaign, Campaign.load),
    "scene": Kind("scene.toml", lambda path: path.write_text(tomli_w.dumps(scene_table())), RenderPlan.load),
    "run results": Kind("results.sqlite", _run, _read_run),
    "run edits": Kind("edits.jsonl", _run, _read_run),
    "run provenance": Kind("provenance.json", _run, _read_run),
    "gauntlet images": Kind("images.jsonl", _gauntlet, lambda path: load_results(path.parent, _GAUNTLET)),
    "dossier": Kind("dossier.json", _dossier, lambda path: check_dossier(path.parent)),
    "observables": Kind("o.parquet", _observables, read_observables),
    "star index": Kind("i.npz", _index, _read_index),
    "sumfile": Kind("a.SUM", _sumfile, read_sumfile),
    "sumfile geometry": Kind("a.SUM", _sumfile, _read_sumfile_geometry),
    "control network": Kind("n.pvl", _with(CONTROL_NETWORK), read_control_network),
    "image support data": Kind("i.isd", _with(json.dumps(IMAGE_SUPPORT)), read_image_support),
    "lmk": Kind("a.LMK", _lmk, read_lmk),
    "orbit covariance": Kind("arc.csv", _with(_table(",".join(COLUMNS[:6]), "4,0.1,1,0,0,9")), read_orbit_covariance),
    "attitude table": Kind(
        "attitudes.csv", _with("name,qx,qy,qz,qw\na.fits,0,0,0,1\nb.fits,0,0,0.6,0.8\n"), read_attitude_table
    ),
    "tdm of others": Kind("o.tdm", _with(TDM), external._tdm),
    "observables of others": Kind("o.csv", _with(SEEN), external._rows),
    "frames": Kind("frames.toml", _frames, frames_table),
    "kernel meta": Kind("k.tm", _meta_kernel, _read_kernel),
    "kernel pck": Kind("k.tpc", lambda path: kernel_files.write_pck(path), _read_kernel),
    "kernel lsk": Kind("k.tls", _with(LEAPSECONDS), _read_kernel),
    "kernel fk": Kind("k.tf", _with(FRAME), _read_kernel),
    "kernel spk": Kind("k.bsp", _spk, _read_spk),
}
"""Kinds of files, by name."""
